"""Trains a judge of success from pictures. ``rsjax judge runs/tiny``"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options, part
from rsjax.tools.policies.judges.judge_training import JudgeSettings


@dataclass(frozen=True)
class Options(JudgeSettings):
    """Trains a classifier (success, fail, uninterpretable) on a run's clips, and validates it on held-out video."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A run directory, made by rsjax train."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    store: Path | None = None
    """The new path of the run's store of ingested clips, if it was moved."""
    also: tuple[Path, ...] = ()
    """More stores of clips to learn from, such as policies' episodes (rsjax record); --head matches their rate."""
    head: bool = False
    """Train nothing, but validate the model's own success head as a judge (--model.state-heads on)."""


@main_errors()
def main() -> None:
    """Writes RUN/judge and prints the results of the validation."""
    tune_process()
    options = parse_options(sys.argv[1:], "rsjax judge", Options.__doc__ or "", Options())
    from rsjax.tools.policies.judges import head_judge, judge_training
    from rsjax.tools.policies.judges.validation import confusion_table, whole_clips
    from rsjax.tools.policies.run_data import with_clips
    from rsjax.tools.studies.tables import as_markdown

    run = with_clips(options.run)
    settings = part(options, JudgeSettings)
    make = judge_training.make_judge
    folder = judge_training.FOLDER
    if options.head:
        make = judge_training.validate_heads
        folder = head_judge.FOLDER
    result = make(run, options.data_dir, options.store, settings, options.also)
    print(f"judge on {result['clips']} held-out clips: frames by label\n\n{as_markdown(confusion_table(result))}\n")
    if whole := whole_clips(result):
        print(f"whole clips, by how many frames in a row must show success\n\n{as_markdown(whole)}\n")
    print(options.run / folder)
