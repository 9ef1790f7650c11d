"""Policies from synthetic and real demonstrations (Table 3). ``rsjax policy_learning runs/tiny``"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rsjax.errors import UserError
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options, part
from rsjax.tools.policies.studies.policy_learning import Learning
from rsjax.tools.policies.studies.trials import Trials


@dataclass(frozen=True)
class Options(Learning, Trials):
    """Trains policies on synthetic and on real demonstrations and compares their success in the simulator."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A run directory on simulated clips, made by rsjax train."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    synthetic: Path | None = None
    """A store of synthetic demonstrations; default: RUN/synthetic/clips, made by rsjax synthesize."""
    size: str = "tiny"
    """Size of the policy: public, tiny or toy."""
    steps: int = 0
    """Training steps of each policy; 0: those of its size."""
    seed: int = 0
    """Seed for choosing real demonstrations."""
    out: Path | None = None
    """Directory of policies and results; default RUN/policy_learning."""

    def __post_init__(self) -> None:
        Learning.__post_init__(self)
        Trials.__post_init__(self)
        if self.seed < 0:
            raise UserError(f"--seed is {self.seed}; it must be at least 0")


@main_errors()
def main() -> None:
    """Writes results.json, results.md and success.png, and prints the table."""
    tune_process()
    options = parse_options(sys.argv[1:], "rsjax policy_learning", Options.__doc__ or "", Options())
    from rsjax.tools.policies.demos import Demos
    from rsjax.tools.policies.run_data import RunData, sized_policy, synthetic_demos, with_clips
    from rsjax.tools.policies.studies.policy_learning import learn
    from rsjax.tools.policies.studies.trials import open_lift

    run = RunData(with_clips(options.run), options.data_dir)
    out = options.out or options.run / "policy_learning"
    config = sized_policy(options.size, options.steps)
    learning = part(options, Learning)
    trials = part(options, Trials)
    synthetic = Demos((), 1)
    if any(cell.synthetic for cell in learning.chosen()):
        synthetic = synthetic_demos(options.synthetic or options.run / "synthetic" / "clips", options.run)
    real = run.demos(seed=options.seed)
    with open_lift(run.simulator, trials) as simulator:
        learn(learning, config, real, synthetic, simulator, trials, out)
    print((out / "results.md").read_text(), out, sep="\n")
