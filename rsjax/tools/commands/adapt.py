"""Adapts a world model to policies. ``rsjax adapt runs/tiny --policy DIR``"""

import shlex
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import tyro

from rsjax.config import ConfigError, require
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options, part
from rsjax.tools.policies.studies.adaptation import Adaptation

PROG = "rsjax adapt"


@dataclass(frozen=True)
class Options(Adaptation):
    """Fine-tunes a world model for minutes on what policies do in the simulator, and measures it before and after."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A run directory, made by rsjax train."""
    policy: tuple[Path, ...] = ()
    """Directories of policies, whose rollouts in the simulator the model learns from; success in it is measured too."""
    episodes: Path | None = None
    """A store of recorded episodes to learn from instead; its test split is held out."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    judge: Path | None = None
    """Folder of the judge of success, or head: each model's own success head; default: the run's (rsjax judge)."""
    trials: int = 50
    """Episodes of each policy in which success is measured."""
    max_steps: int = 30
    """Steps of a rollout, and of an episode in which success is measured."""
    together: int = 5
    """Episodes that run at a time."""
    out: Path | None = None
    """Directory of the new runs and results; default RUN-adapted."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("trials", "max_steps", "together"):
            value = getattr(self, name)
            require(value >= 1, f"--{name.replace('_', '-')} is {value}; it must be at least 1")


@main_errors()
def main() -> None:
    """Writes a run directory for each round, results.json and results.md, and prints the table."""
    tune_process()
    options = parse_options(sys.argv[1:], PROG, Options.__doc__ or "", Options())
    if not options.policy and not options.episodes:
        raise ConfigError("name policies with --policy DIR, recorded episodes with --episodes STORE, or both")
    from rsjax.data.store import open_store
    from rsjax.tools.policies.policy import check_fits, load_policy
    from rsjax.tools.policies.run_data import RunData, named
    from rsjax.tools.policies.studies.adaptation import Behaviour, adapt, scores_of
    from rsjax.tools.policies.studies.trials import Trials, open_lift
    from rsjax.tools.policies.worlds.actions import check_takes_actions

    data = RunData(options.run, options.data_dir)
    check_takes_actions(data.config.model, f"{options.run}: the model")
    scores_of(data.run)  # raises before simulators start if the run was not evaluated
    if options.episodes:
        open_store(options.episodes)  # raises before simulators start if there is none
    trials = Trials(options.trials, options.max_steps, options.together)
    out = options.out or options.run.absolute().with_name(f"{options.run.absolute().name}-adapted")
    policies = {name: load_policy(place) for name, place in named(options.policy).items()}
    with ExitStack() as stack:
        simulator = None
        if policies:
            config = data.simulator
            # Checked before minutes of work:
            data.check_world(data, options.judge)
            data.world_judge(options.judge)
            for name, policy in policies.items():
                check_fits(policy.sizes, data.config.clips, name)
            simulator = stack.enter_context(open_lift(config, trials))
        behaviour = Behaviour(policies, simulator, trials, options.judge, options.episodes)
        adapt(data, behaviour, part(options, Adaptation), out, shlex.join([*PROG.split(), *sys.argv[1:]]))
    print((out / "results.md").read_text(), out, sep="\n")
