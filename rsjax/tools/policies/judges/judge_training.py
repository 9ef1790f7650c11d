"""Trains the judge of a run, validates it on held-out clips, and saves both in the run directory."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.clip import Video
from rsjax.config.fields import require_range
from rsjax.data.clips import Clips, readable, spread
from rsjax.data.store import Record, Store
from rsjax.errors import UserError
from rsjax.files import write_json
from rsjax.models.load_run import load
from rsjax.models.trained import TrainedModel
from rsjax.progress import Progress
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.run_clips import relocated
from rsjax.tools.policies.judges.judge import Judge
from rsjax.tools.policies.judges.trained_judge import VALIDATION, Footage, load_judge, train_judge
from rsjax.tools.policies.judges.validation import validate

FOLDER = "judge"  # in the run directory
FITTED = 10  # every tenth training clip serves to fit the temperature instead


@dataclass(frozen=True)
class JudgeSettings:
    """The settings for training and validating a judge.

    Attributes:
        steps: training steps.
        clips: training clips, at most.
        reconstructed: how many of these clips the judge also sees as the tokenizer reconstructs them, so that it knows
            the look of generated frames; their labels are the simulator's too.
        validation_clips: held-out clips, at most.
        seed: seed of the training.
    """

    steps: int = 1000
    clips: int = 1000
    reconstructed: int = 200
    validation_clips: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        require_range(self, "judge", 1, math.inf, "steps", "validation_clips")
        require_range(self, "judge", 2, math.inf, "clips")
        require_range(self, "judge", 0, 2**32 - 1, "reconstructed", "seed")


def judge_of(run: Path | str | TrainedModel, judge: Judge | Path | str | None, side: int) -> Judge | None:
    """Returns ``judge`` itself, the judge in that directory, or for "run" the run's judge if it has one.

    Args:
        side: of the run's frames, pixels.

    Raises:
        UserError: the directory has no judge, its file is damaged, or it takes frames of another size.
    """
    if judge == "run":
        if isinstance(run, TrainedModel):
            folder = None
        else:
            folder = Path(run) / FOLDER
        if folder is not None and folder.exists():
            return load_judge(folder, side)
        return None
    if isinstance(judge, Path | str):
        return load_judge(Path(judge), side)
    return judge


def make_judge(
    run: Path, data_dir: Path, store: Path | None = None, settings: JudgeSettings | None = None
) -> dict[str, Any]:
    """Trains the judge of a run and returns its validation, which is also in ``RUN/judge/validation.json``.

    Raises:
        UserError: the run or its clips are missing, or its clips do not show both success and failure.
    """
    settings = settings or JudgeSettings()
    trained = load(run)
    if store:
        config = relocated(trained.config, store)
    else:
        config = trained.config
    clips = Run(config, run, data_dir).open_clips()
    learned, fitted = _training(trained, clips, settings)
    judge = train_judge(learned, fitted, settings.steps, settings.seed)
    numbers = spread(clips.source("test"), settings.validation_clips)
    held = [clip for _, clip in readable(clips.source("test"), numbers)]
    result = validation(trained, judge, held) | {"settings": vars(settings), "judge": judge.key}
    judge.save(run / FOLDER)
    write_json(run / FOLDER / VALIDATION, result)
    return result


def validation(trained: TrainedModel, judge: Judge, clips: Sequence[Record]) -> dict[str, Any]:
    """Validates a judge on clips as they are, as the tokenizer reconstructs them, and as the model generates them."""
    held = Clips.stacked(clips, range(len(clips)))
    first = trained.config.prompt_frames
    raw = Footage(held.rgb, held.success)
    video = held.video
    made = []
    result = {"clips": len(clips), "raw": validate(judge, raw, first, spoil=True)}
    if (seen := _reconstructed(trained, raw.rgb)) is not None:
        result["reconstructed"] = validate(judge, Footage(seen, raw.success), first)
    size = trained.config.eval.batch_size
    with Progress("judge's videos", len(clips), "videos") as progress:
        for start in range(0, len(clips), size):
            rows = np.minimum(np.arange(start, start + size), len(clips) - 1)  # batches of one shape
            prompt = video[rows].frames(0, first)
            inputs = (trained.params, trained.assets, prompt, held.actions[rows])
            made.append(trained.model.generate(*inputs, index=rows, depth=False).rgb)
            progress.update(min(start + size, len(clips)))
    generated = np.concatenate(made)[: len(clips)]
    return result | {"generated": validate(judge, Footage(generated, raw.success), first)}


def _training(trained: TrainedModel, clips: Store, settings: JudgeSettings) -> tuple[Footage, Footage]:
    """Returns the videos to learn from and the videos to fit the temperature on, each raw and reconstructed."""
    source = clips.source("train")
    records = [clip for _, clip in readable(source, spread(source, settings.clips))]
    if len(records) < 2:
        raise UserError(f"{clips.path}: {len(records)} readable training clips; a judge needs 2 at least")
    raw = Footage(*(np.stack([clip[name] for clip in records]) for name in ("rgb", "success")))
    seen = _reconstructed(trained, raw.rgb[: settings.reconstructed])
    if seen is None:
        rgb = raw.rgb
    else:
        rgb = np.concatenate([raw.rgb, seen])
    if seen is None:
        success = raw.success
    else:
        success = np.concatenate([raw.success, raw.success[: len(seen)]])
    if len(raw.rgb) >= FITTED:
        held = np.arange(len(rgb)) % len(raw.rgb) % FITTED == FITTED - 1
    else:
        held = None
    if held is None:  # so few clips serve both purposes
        return Footage(rgb, success), Footage(rgb, success)
    return Footage(rgb[~held], success[~held]), Footage(rgb[held], success[held])


def _reconstructed(trained: TrainedModel, rgb: np.ndarray) -> np.ndarray | None:
    """Returns the tokenizer's reconstructions of videos; None for a family without a tokenizer."""
    if not len(rgb):
        return None
    video = trained.model.reconstruct(trained.assets, Video(rgb))
    if video is None:
        return None
    return video.rgb
