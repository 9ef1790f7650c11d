"""Improves a policy in a world model. ``rsjax improve runs/tiny --demos 50``"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options, part
from rsjax.tools.policies.studies.improvement import Improvement
from rsjax.tools.policies.studies.trials import Trials


@dataclass(frozen=True)
class Options(Improvement, Trials):
    """Rolls out a policy in a world model, trains it on the rollouts that the judge calls a success, and repeats."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A run directory on simulated clips, made by rsjax train."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    judge: Path | None = None
    """Folder of the judge, or head: the model's own success head; default: the run's judge (rsjax judge)."""
    policy: Path | None = None
    """Directory of the policy to start with; default: train one on --demos real demonstrations."""
    demos: int = 50
    """Real demonstrations that the policy was, or is, trained on."""
    demos_from: Path | None = None
    """Store of these demonstrations; default: the run's clips."""
    size: str = "tiny"
    """Size of that policy: public, tiny or toy."""
    train_steps: int = 0
    """Training steps of that policy; 0: those of its size."""
    out: Path | None = None
    """Directory of policies and results; default RUN/improve."""

    def __post_init__(self) -> None:
        Improvement.__post_init__(self)
        Trials.__post_init__(self)


@main_errors()
def main() -> None:
    """Writes results.json, results.md and success.png, and prints the table."""
    tune_process()
    options = parse_options(sys.argv[1:], "rsjax improve", Options.__doc__ or "", Options())
    from rsjax.data.store import open_store
    from rsjax.tools.policies.demos import load_demos
    from rsjax.tools.policies.policy import check_fits, load_policy
    from rsjax.tools.policies.policy_training import train_policy
    from rsjax.tools.policies.run_data import RunData, sized_policy, with_clips
    from rsjax.tools.policies.studies.improvement import improve, new_starts
    from rsjax.tools.policies.studies.trials import open_lift

    run = RunData(with_clips(options.run), options.data_dir)
    out = options.out or options.run / "improve"
    settings = part(options, Improvement)
    trials = part(options, Trials)
    config = run.simulator  # checks the clips before a policy is trained
    model = run.world(trials.together, options.judge)
    if options.demos_from:
        demos = load_demos(open_store(options.demos_from), ["train"])
    else:
        demos = run.demos()
    demos = demos.first(options.demos)
    starts = run.first_frames(settings.imagined * settings.rounds + len(demos))
    # Checked before a policy is trained:
    check_fits((demos.image_size, demos.controls * demos.width), run.config.clips, "the demonstrations")
    if options.follow_demos:
        starts = new_starts(starts, demos)
    if options.policy:
        policy = load_policy(options.policy)
        check_fits(policy.sizes, run.config.clips, "--policy")
    else:
        policy = train_policy(sized_policy(options.size, options.train_steps), demos, out / "policy")
    with open_lift(config, trials) as simulator:
        improve(policy, demos, starts, model, simulator, settings, trials, out)
    print((out / "results.md").read_text(), out, sep="\n")
