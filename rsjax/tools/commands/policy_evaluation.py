"""Policies judged in world models (Fig. 5). ``rsjax policy_evaluation runs/tiny runs/no-depth``"""

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tyro

from rsjax.config import ConfigError
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options, part
from rsjax.tools.policies.studies.trials import Trials


@dataclass(frozen=True)
class Options(Trials):
    """Rolls out policies from the same first frames in the simulator and in world models, and compares success."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Run directories on the same simulated clips: RoboScape, ablations, baselines."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    judge: Path | None = None
    """Folder of the judge for all runs, or head: each model's own success head; default: the first run's judge."""
    imagined: int = 0
    """Episodes of each policy in a world model, at least --episodes; 0: four times as many as --episodes."""
    policies: tuple[Path, ...] = ()
    """Directories of trained policies to compare; default: checkpoints of policies trained on real demonstrations."""
    trainings: int = 2
    """Number of trainings of that policy, with seeds of their own, for an interval of r over trainings."""
    checkpoints: int = 8
    """Number of checkpoints of each training."""
    demos: int = 200
    """Number of demonstrations that it is trained on."""
    size: str = "tiny"
    """Size of that policy: public, tiny or toy."""
    steps: int = 0
    """Training steps of that policy; 0: those of its size."""
    blind: Path | None = None
    """Instead: write the rollouts in --out to this new folder for people to judge, with a labels.csv to fill in."""
    judge_with: str = ""
    """Instead: judge these rollouts again, with human:LABELS.csv of --blind or vlm:DIRECTORY, a language model."""
    out: Path | None = None
    """Directory of policies and results; default RUN/policy_evaluation of the first run."""


@main_errors()
def main() -> None:
    """Writes results.json, results.md, scatter.png and videos, and prints the table."""
    tune_process()
    options = parse_options(sys.argv[1:], "rsjax policy_evaluation", Options.__doc__ or "", Options())
    if not options.runs or options.checkpoints < 2 or options.trainings < 1:
        raise ConfigError(
            "name a run directory at least, --checkpoints 2 or more, --trainings 1 or more: policy_evaluation runs/tiny"
        )
    from rsjax.tools.policies.judges.head_judge import head_rule
    from rsjax.tools.policies.judges.judge_training import FOLDER
    from rsjax.tools.policies.policy import check_fits, load_policy
    from rsjax.tools.policies.run_data import RunData, named, replicates, sized_policy, training_of
    from rsjax.tools.policies.studies.policy_evaluation import check_imagined, compare, trained_policies
    from rsjax.tools.policies.studies.rejudging import blind, named_judge, rejudge
    from rsjax.tools.policies.studies.trials import open_lift

    runs = {name: RunData(run, options.data_dir) for name, run in named(options.runs).items()}
    first = next(iter(runs.values()))
    trials = part(options, Trials)
    out = options.out or first.run / "policy_evaluation"
    judge = options.judge or first.run / FOLDER
    if options.blind:
        print(blind(out, options.blind))
        return
    if options.judge_with:
        place = rejudge(out, *named_judge(options.judge_with))
        print((place / "results.md").read_text(), place, sep="\n")
        return
    for run in runs.values():  # checked before hours of training
        run.check_world(first, judge)
    first.world_judge(judge)
    rule = head_rule(first.run)
    config = first.simulator
    imagined = options.imagined or 4 * trials.episodes
    check_imagined(imagined, trials)
    if options.policies:
        places = named(options.policies)
        policies = {name: load_policy(place) for name, place in places.items()}
        training = {name: training_of(place) for name, place in places.items()}
    else:
        demos = first.demos().first(options.demos)
        size = sized_policy(options.size, options.steps)
        policies, training = trained_policies(size, demos, out, options.checkpoints, options.trainings)
    for name, policy in policies.items():
        check_fits(policy.sizes, first.config.clips, name)
    worlds = {name: partial(run.world, trials.together, judge, measured=True, rule=rule) for name, run in runs.items()}
    with open_lift(config, trials) as simulator:
        compare(
            policies,
            simulator,
            worlds,
            trials,
            out,
            imagined=imagined,
            training=training,
            replicates=replicates(runs),
        )
    print((out / "results.md").read_text(), out, sep="\n")
