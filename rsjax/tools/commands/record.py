"""Records policies in the simulator. ``rsjax record runs/tiny --policies DIR … --episodes 25``"""

import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import tyro

from rsjax.config import ConfigError
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options

FIRST = 1_000_000  # number of the first episode; those of rsjax adapt are smaller


@dataclass(frozen=True)
class Options:
    """Records episodes of policies in the simulator, as the recipe recorded:PATH takes them (docs/simulators.md)."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A run directory on simulated clips, whose camera, frames and control steps the recordings have."""
    policies: tuple[Path, ...] = ()
    """Directories of trained policies, such as RUN/policy_evaluation/policy/at-90; they take turns."""
    episodes: int = 25
    """Episodes of each policy."""
    max_steps: int = 0
    """Steps of an episode; 0: as many as the run's clips have."""
    together: int = 5
    """Episodes that run at a time."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    out: Path | None = None
    """Directory of the recordings; default RUN/recorded."""


@main_errors()
def main() -> None:
    """Writes a store of the episodes and prints the recipe that takes it."""
    tune_process()
    options = parse_options(sys.argv[1:], "rsjax record", Options.__doc__ or "", Options())
    if not options.policies or min(options.episodes, options.together) < 1 or options.max_steps < 0:
        raise ConfigError(
            f"--policies names {len(options.policies)}, --episodes is {options.episodes}, --together "
            f"{options.together}, --max-steps {options.max_steps}: 1, 1, 1 and 0 at least"
        )
    from rsjax.config import content_key
    from rsjax.processes import count_cores
    from rsjax.tools.policies.on_policy import rollouts
    from rsjax.tools.policies.policy import check_fits, load_policy
    from rsjax.tools.policies.run_data import RunData, named
    from rsjax.tools.policies.worlds.simulator_world import SimulatorWorld

    data = RunData(options.run, options.data_dir)
    config = data.simulator
    policies = {name: load_policy(place) for name, place in named(options.policies).items()}
    for name, policy in policies.items():
        check_fits(policy.sizes, data.config.clips, name)
    total = options.episodes * len(policies)
    numbers = {"train": range(FIRST, FIRST + total)}
    keys = str([policy.key for policy in policies.values()])
    together = min(options.together, options.episodes)  # what a policy draws depends on it
    steps = options.max_steps or config.frames - 1
    of = content_key("recorded", 3, config, keys, total, together, steps)
    folder = (options.out or options.run / "recorded") / of
    with closing(SimulatorWorld.lift(config, together, count_cores())) as world:
        store = rollouts(policies, world, config, numbers, steps, folder, "record")
    share = store.manifest["success_share"]
    print(f"{total} episodes, {100 * share:.0f} % end in success")
    print(f"--sim.recipe expert recorded:{store.path}")
