"""Plans in a world model and acts in the simulator. ``rsjax plan runs/tiny --energy judge``"""

import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options


@dataclass(frozen=True)
class Options:
    """Controls the simulator by planning in a run's world model (MPC), and compares this with random and the expert."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A run directory, made by rsjax train on simulated clips."""
    methods: tuple[Literal["cem", "mppi"], ...] = ("cem", "mppi")
    """Ways to search."""
    energy: Literal["judge", "success", "tokens", "pixels", "lpips"] = "judge"
    """What to minimise at the horizon: 1 - the probability of success, by the judge (rsjax judge) or by the
    model's own success head (by the rule of rsjax judge --head); or the distance of the last frame to a goal
    image, which is the expert's last frame."""
    lpips_weights: str = ""
    """Weights for the energy lpips (docs/evaluation.md)."""
    policy: Path | None = None
    """A policy of rsjax policy_learning to compare with as well."""
    warm_start: bool = False
    """Also plan with the policy's own rollouts in the world model among the candidates."""
    from_clips: bool = False
    """Also plan with what followed the most similar frames of successful training clips among the candidates."""
    data_dir: Path = Path("data")
    """Directory of the simulated data sets, for from-clips."""
    episodes: int = 50
    """Episodes for each way to act, with equal starts."""
    max_steps: int = 30
    """Largest number of frames in an episode."""
    horizon: int = 12
    """Frames that a candidate looks ahead."""
    candidates: int = 32
    """Action sequences per round."""
    rounds: int = 3
    """Rounds per decision."""
    elites: int = 6
    """Number of best candidates that cem continues from."""
    temperature: float = 0.5
    """Temperature of mppi, in standard deviations of the energies."""
    seed: int = 0
    """Seed of the candidates."""


@main_errors()
def main() -> None:
    """Writes result.json, results.md and videos to RUN/plan/KEY, and prints a table."""
    tune_process()
    options = parse_options(sys.argv[1:], "rsjax plan", Options.__doc__ or "", Options())
    from rsjax.models.load_run import load
    from rsjax.tools.pipeline.limits import check_together
    from rsjax.tools.policies.planning.closed_loop import PlanSettings, compare, folder, results_text
    from rsjax.tools.policies.planning.planner import PlannerConfig
    from rsjax.tools.policies.policy import load_policy
    from rsjax.tools.policies.run_data import RunData
    from rsjax.tools.policies.worlds.simulator_world import SimulatorWorld

    fields = ("horizon", "candidates", "rounds", "elites", "temperature", "seed")
    planner = PlannerConfig(**{name: getattr(options, name) for name in fields})
    limits = (options.episodes, options.max_steps, options.warm_start)
    settings = PlanSettings(planner, options.methods, options.energy, options.lpips_weights, *limits)
    trained = load(options.run)
    at_once = f"--candidates {options.candidates} and --horizon {options.horizon}"
    check_together(trained.config, options.candidates, options.horizon, at_once)
    policies: dict[str, Any] = {}
    if options.policy:
        policies["policy"] = load_policy(options.policy)
    clips = None
    if options.from_clips:
        clips = RunData(options.run, options.data_dir).clips
    with closing(SimulatorWorld.lift(trained.config.sim, 1)) as simulator:
        result = compare(trained, options.run, simulator, settings, policies, clips)
    print(results_text(result))
    print(folder(options.run, result["key"]) / "result.json")
