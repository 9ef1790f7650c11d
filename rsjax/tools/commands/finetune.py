"""Fine-tunes a model on your recordings. ``rsjax finetune tiny --data lerobot:/data/pusht --out runs/mine``"""

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from rsjax.config import ConfigError
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options, part

PROG = "rsjax finetune"


@dataclass(frozen=True)
class Options:
    """Ingests recordings, adapts the tokenizer if it has to, trains the world model, evaluates, and writes a report."""

    model: tyro.conf.Positional[str] = ""
    """tiny or multitask, a run directory, a saved model, or a directory of converted public weights."""
    data: str = ""
    """SOURCE:PATH, such as lerobot:/data/pusht, with a source of rsjax ingest; or a store of clips."""
    out: Path = Path("runs/finetuned")
    """Directory of the run."""
    steps: int = -1
    """Training steps of the world model at most; an early stop on held-out clips may end it before. 0: none; -1: each
    clip 54 times, at most 1500 steps."""
    tokenizer_steps: int = -1
    """Those of the tokenizer, if it is adapted; -1: each clip 27 times, at most 600 steps."""
    tokenizer: Literal["measure", "keep", "adapt"] = "measure"
    """measure: keep it if it reconstructs held-out frames 3 dB better than the first frame repeated would."""
    learning_rate: float = 0.5
    """Peak of the learning rate, as a share of that which the model was trained with."""
    tokenizer_learning_rate: float = 1.0
    """Likewise, of the tokenizer."""
    short_share: float = 0.0
    """Share of the world model's steps that train on the first half of each clip, which costs half."""
    patience: int = -1
    """Validations in a row without a better one that end a training; a whole training has 8, so 3 ends many early, and
    the best weights count. 0: the world model's last weights count; -1: 8, or 0 with fewer than 30 held-out clips."""
    seed: int = 0
    """Seed of both trainings."""
    keep_still: Literal["measure", "on", "off"] = "measure"
    """Keep from a clip's first frame what does not change, which the tokenizer would blur; measure: if less than half
    of the pixels move in held-out clips. It changes videos, not the training's losses."""
    backwards: Literal["measure", "on", "off"] = "measure"
    """Let half of the training clips run backwards, with the actions that lead back; measure: if there are fewer than
    300, and their actions are poses or other targets. on: also where they are steps."""
    frames: int = 0
    """Frames of a clip; 0: as many as the model takes, or fewer if episodes are short."""
    rate: float = 0.0
    """Frames per second, about; 0: 5, or those of the recordings if they have fewer."""
    camera: str = ""
    """The camera to use; the episode's first by default."""
    option: tuple[str, ...] = ()
    """The source's own settings, such as kind=delta (docs/formats.md)."""
    depth: str = "recorded"
    """recorded, none, or a network that estimates depth, such as depth-anything:… (docs/annotate.md)."""
    delay: int = 0
    """Recorded frames by which commands act later than the data set says, and by which clips have them later; -1:
    measured on training episodes, by how much of the motion in the picture they explain."""
    test_share: float = 0.2
    """Share of the episodes that scores are of; no training sees them."""
    validation_share: float = 0.1
    """Share of the episodes that choose the best weights and, with --patience, end a training early."""
    split_seed: int = 0
    """Another number chooses other episodes for both."""
    workers: int = -1
    """Processes that ingest; -1: one per core."""
    dry_run: bool = False
    """Stop before the training, after the clips were made and the time was estimated."""

    @property
    def made_run(self) -> Path:
        """The run of the last line of the output."""
        return self.out


@main_errors()
def main() -> None:
    """Fine-tunes, and says how good the result is."""
    tune_process()
    options = parse_options(sys.argv[1:], PROG, Options.__doc__ or "", Options())
    for name, value in (("MODEL", options.model), ("--data", options.data)):
        if not value:
            raise ConfigError(
                f"name {name}; usage: {PROG} tiny --data lerobot:/data/pusht --out runs/mine (see {PROG} --help)"
            )
    from rsjax.evaluation.verdict import verdict
    from rsjax.files import read_json
    from rsjax.tools.finetune.finetune import finetune
    from rsjax.tools.finetune.recipe import Finetuning
    from rsjax.tools.finetune.recordings import Cutting, find_recordings
    from rsjax.tools.finetune.start import find_source

    cutting = part(options, Cutting)
    settings = part(options, Finetuning)
    command = shlex.join([*PROG.split(), *sys.argv[1:]])
    recordings = find_recordings(options.data, cutting)
    source = find_source(options.model)
    run = finetune(source, recordings, cutting, settings, options.out, command, options.dry_run)
    if options.dry_run:
        print(f"nothing is trained; rsjax describe {run.directory} counts the operations in detail")
        return
    print(verdict(read_json(run.directory / "metrics.json")))
    print(f"report: {run.output('report').absolute()}")
