"""Trains the judge of a run, validates it on held-out clips, and saves both in the run directory."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.clip import Video
from rsjax.config.fields import require_range
from rsjax.data.clips import Clips, first_clip, readable, spread
from rsjax.data.state_labels import knows_success
from rsjax.data.store import Record, Store, open_store
from rsjax.errors import UserError
from rsjax.files import write_json
from rsjax.models.load_run import load
from rsjax.models.trained import TrainedModel
from rsjax.progress import Progress, note
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.run_clips import relocated
from rsjax.tools.policies.judges.head_judge import FOLDER as HEAD_FOLDER
from rsjax.tools.policies.judges.head_judge import HeadJudge, head_judge, likeliest, matching_shift
from rsjax.tools.policies.judges.judge import FAIL, LABELS, SUCCESS, Judge
from rsjax.tools.policies.judges.trained_judge import VALIDATION, Footage, load_judge, train_judge
from rsjax.tools.policies.judges.validation import outcomes, scores, validate

FOLDER = "judge"  # in the run directory
FITTED = 10  # every tenth training clip serves to fit the temperature instead


@dataclass(frozen=True)
class JudgeSettings:
    """The settings for training and validating a judge.

    Attributes:
        steps: training steps.
        clips: training clips of each store, at most.
        reconstructed: how many of a store's clips the judge also sees as the tokenizer reconstructs them, so that it
            knows the look of generated frames; their labels are the simulator's too.
        generated: how many of a store's clips the judge also sees as the model generates them under their own actions.
            The labels are the simulator's of the same actions: where the model lifts a cube that slipped in the
            simulator, the judge learns to call it a failure.
        in_a_row: how many frames in a row must show success.
        validation_clips: held-out clips, at most.
        seed: seed of the training.
    """

    steps: int = 1000
    clips: int = 1000
    reconstructed: int = 200
    generated: int = 0
    in_a_row: int = 1
    validation_clips: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        require_range(self, "judge", 1, math.inf, "steps", "validation_clips")
        require_range(self, "judge", 2, math.inf, "clips")
        require_range(self, "judge", 0, 2**32 - 1, "reconstructed", "generated", "seed")
        require_range(self, "judge", 1, 16, "in_a_row")


def judge_of(run: Path | str | TrainedModel, judge: Judge | Path | str | None, side: int) -> Judge | None:
    """Returns ``judge`` itself, the judge in that directory, or for "run" the run's judge if it has one.

    Args:
        side: of the run's frames, pixels.

    Raises:
        UserError: the directory has no judge, its file is damaged, or it takes frames of another size.
    """
    if judge == "run":
        if isinstance(run, TrainedModel):
            directory = run.directory
        else:
            directory = Path(run)
        if directory is not None and (directory / FOLDER).exists():
            return load_judge(directory / FOLDER, side)
        return None
    if isinstance(judge, Path | str):
        return load_judge(Path(judge), side)
    return judge


def make_judge(
    run: Path,
    data_dir: Path,
    store: Path | None = None,
    settings: JudgeSettings | None = None,
    also: Sequence[Path] = (),
) -> dict[str, Any]:
    """Trains the judge of a run and returns its validation, which is also in ``RUN/judge/validation.json``.

    Args:
        also: stores whose training clips it learns from as well, such as clips of policies' own episodes.

    Raises:
        UserError: the run or its clips are missing, its clips do not show both success and failure, or those of a store
            in ``also`` have no label of success, or other pictures or actions than the run's.
    """
    settings = settings or JudgeSettings()
    trained = load(run)
    clips = _clips_of(trained, run, data_dir, store)
    test_clips = _held_out(clips, settings)
    learned, fitted = _training(trained, [clips, *map(open_store, also)], settings)
    judge = replace(train_judge(learned, fitted, settings.steps, settings.seed), in_a_row=settings.in_a_row)
    result = validation(trained, judge, test_clips) | {"settings": vars(settings), "judge": judge.key}
    judge.save(run / FOLDER)
    write_json(run / FOLDER / VALIDATION, result)
    return result


def validation(trained: TrainedModel, judge: Judge, clips: Sequence[Record]) -> dict[str, Any]:
    """Validates a judge on clips as they are, as the tokenizer reconstructs them, and as the model generates them."""
    batch = Clips.stacked(clips, range(len(clips)))
    first = trained.config.prompt_frames
    raw = Footage(batch.rgb, batch.success)
    result = {"clips": len(clips), "raw": validate(judge, raw, first, corrupt=True)}
    if (decoded := _reconstructed(trained, raw.rgb)) is not None:
        result["reconstructed"] = validate(judge, Footage(decoded, raw.success), first)
    made = imagined(trained, batch)
    return result | {"generated": validate(judge, Footage(made.rgb, raw.success), first)}


def validate_heads(
    run: Path,
    data_dir: Path,
    store: Path | None = None,
    settings: JudgeSettings | None = None,
    also: Sequence[Path] = (),
) -> dict[str, Any]:
    """Validates a model's own success head as a judge, and writes the result to ``RUN/judge_head/validation.json``.

    Args:
        also: stores of clips or whole episodes, of which the model generates ``settings.clips`` each; the head's logit
            is shifted so that it calls as many of them a success as the simulator does.

    Raises:
        UserError: the run or its clips are missing, the model has no state heads, or the clips of a store in ``also``
            do not fit, as for :func:`make_judge`.
    """
    settings = settings or JudgeSettings()
    trained = load(run)
    head_judge(trained, run)
    own = _clips_of(trained, run, data_dir, store)
    test_clips = _held_out(own, settings)
    shift = 0.0
    if also:
        first = trained.config.prompt_frames
        likely = []
        success = []
        for path in also:
            records = _labelled(open_store(path), own, settings.clips, longer=True)
            batch = Clips.stacked(records, range(len(records)))
            made = imagined(trained, batch).frames(first)
            assert made.state is not None
            likely.append(likeliest(made.state, settings.in_a_row))
            success.append(batch.success[:, first:].any(axis=1))
        true = np.concatenate(success)
        shift = matching_shift(np.concatenate(likely), true)
        note(f"the head's logit of success is shifted by {shift:+.2f}, to match {true.sum()} of {len(true)} clips")
    judge = HeadJudge(settings.in_a_row, shift=shift)
    result = head_validation(trained, judge, test_clips) | {"settings": vars(settings), "shift": shift}
    write_json(run / HEAD_FOLDER / VALIDATION, result)
    return result


def head_validation(trained: TrainedModel, judge: HeadJudge, clips: Sequence[Record]) -> dict[str, Any]:
    """Validates a model's own success head on true frames, each predicted from those before it, and on rollouts."""
    batch = Clips.stacked(clips, range(len(clips)))
    first = trained.config.prompt_frames
    success = batch.success[:, first:]
    truth = np.where(success, SUCCESS, FAIL).ravel()
    forced = trained.model.teacher_forced(trained.params, trained.assets, batch.video, batch.actions, first)
    made = imagined(trained, batch).frames(first)
    assert forced is not None and forced.state is not None and made.state is not None
    result: dict[str, Any] = {"clips": len(clips), "judge": judge.key, "in_a_row": judge.in_a_row}
    for kind, state in (("raw", forced.state), ("generated", made.state)):
        each = [judge.read(state[:, : t + 1]) for t in range(state.shape[1])]
        single = [replace(judge, in_a_row=1).read(state[:, : t + 1]) for t in range(state.shape[1])]
        result[kind] = scores(np.stack(each, 1).reshape(-1, len(LABELS)), truth)
        result[kind]["whole_clips"] = outcomes(np.stack(single), success)
    return result


def imagined(trained: TrainedModel, clips: Clips) -> Video:
    """Returns the videos that the model generates from the clips' first frames under their own actions."""
    size = trained.config.eval.batch_size
    count = len(clips.rgb)
    parts = []
    with Progress("judge's videos", count, "videos") as progress:
        for start in range(0, count, size):
            rows = np.minimum(np.arange(start, start + size), count - 1)  # batches of one shape
            prompt = clips.video[rows].frames(0, trained.config.prompt_frames)
            inputs = (trained.params, trained.assets, prompt, clips.actions[rows])
            parts.append(trained.model.generate(*inputs, index=rows, depth=False)[: count - start])
            progress.update(min(start + size, count))
    states = [part.state for part in parts if part.state is not None]
    return Video(np.concatenate([part.rgb for part in parts]), state=np.concatenate(states) if states else None)


def _clips_of(trained: TrainedModel, run: Path, data_dir: Path, store: Path | None) -> Store:
    if store:
        config = relocated(trained.config, store)
    else:
        config = trained.config
    return Run(config, run, data_dir).open_clips()


def _held_out(clips: Store, settings: JudgeSettings) -> list[Record]:
    source = clips.source("test")
    records = [clip for _, clip in readable(source, spread(source, settings.validation_clips))]
    if not records:
        raise UserError(f"{clips.path}: no test clip can be read; a judge is validated on those")
    return records


def _labelled(clips: Store, own: Store, count: int, longer: bool = False) -> list[Record]:
    """Returns at most ``count`` training clips of a store, which must be labelled and like the run's ``own``.

    Args:
        longer: whether they may have more frames.
    """
    if clips is not own and not knows_success(clips):
        raise UserError(f"{clips.path}: its clips do not say whether they succeed; a judge learns from such labels")
    source = clips.source("train")
    records = [clip for _, clip in readable(source, spread(source, count))]
    if len(records) < 2:
        raise UserError(f"{clips.path}: {len(records)} readable training clips; a judge needs 2 at least")
    theirs, ours = ((clip["rgb"].shape, clip["actions"].shape) for clip in (records[0], first_clip(own)))
    fit = theirs == ours
    if longer:
        fit = theirs[0][1:] == ours[0][1:] and theirs[1][1:] == ours[1][1:] and theirs[0][0] >= ours[0][0]
    if not fit:
        raise UserError(
            f"{clips.path}: the pictures and actions of its clips have the shapes {theirs}, those of the run's {ours}; "
            f"name clips of the run's length, size and actions"
        )
    return records


def _training(trained: TrainedModel, stores: Sequence[Store], settings: JudgeSettings) -> tuple[Footage, Footage]:
    """Returns the videos to learn from and those to fit the temperature on: raw, reconstructed and generated ones.

    Args:
        stores: the run's own clips, and others.
    """
    parts = []
    for clips in stores:
        records = _labelled(clips, stores[0], settings.clips)
        raw = Footage(*(np.stack([clip[name] for clip in records]) for name in ("rgb", "success")))
        parts.append(raw)
        decoded = _reconstructed(trained, raw.rgb[: settings.reconstructed])
        if decoded is not None:
            parts.append(Footage(decoded, raw.success[: len(decoded)]))
        if settings.generated:
            some = Clips.stacked(records[: settings.generated], range(min(len(records), settings.generated)))
            parts.append(Footage(imagined(trained, some).rgb, some.success))
    numbers = np.concatenate([np.arange(len(part.rgb)) for part in parts])  # of a store's clips
    whole = Footage(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("rgb", "success")))
    if len(parts[0].rgb) < FITTED:  # so few clips serve both purposes
        return whole, whole
    fits = numbers % FITTED == FITTED - 1
    return Footage(whole.rgb[~fits], whole.success[~fits]), Footage(whole.rgb[fits], whole.success[fits])


def _reconstructed(trained: TrainedModel, rgb: np.ndarray) -> np.ndarray | None:
    """Returns the tokenizer's reconstructions of videos; None for a family without a tokenizer."""
    if not len(rgb):
        return None
    video = trained.model.reconstruct(trained.assets, Video(rgb))
    if video is None:
        return None
    return video.rgb
