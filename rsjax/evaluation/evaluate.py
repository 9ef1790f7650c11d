"""Evaluates a world model: generates from first frames of the test split and scores all registered metrics.

Axes: B clips, T frames, H×W pixels, A action dimensions, R draws of random actions.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from rsjax.clip import Video
from rsjax.config import EvalConfig
from rsjax.data.clips import Clips, readable, spread
from rsjax.data.codec import Record, decode, encode
from rsjax.data.store import Store, StoreError
from rsjax.evaluation.depth_estimator import choose_estimator, estimate_depth
from rsjax.evaluation.frame_curves import Curves, frame_curves
from rsjax.evaluation.localiser import recorded_places, train_localiser
from rsjax.evaluation.metrics import delta_psnr
from rsjax.evaluation.registry import Located, Metric, PerClip, Places, Scene, Unavailable, metrics
from rsjax.evaluation.shown import shown_arrays
from rsjax.evaluation.statistics import bootstrap
from rsjax.files import write_atomically
from rsjax.ingest.annotators.protocols import DepthEstimator
from rsjax.models.base import TeacherForced
from rsjax.models.trained import TrainedModel
from rsjax.progress import Progress
from rsjax.tokenizers.lpips import load_lpips

LOCALISER_CLIPS = 1000  # training clips from which the localiser learns
RANGE_CLIPS = 1000  # training clips that determine the range of uniform random actions


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation.

    Attributes:
        metrics: scores by name.
        reasons: why a registered metric has no score, by name.
        shown: arrays of the clips in the report, with a leading axis over clips.
        per_clip: the scored clips' own scores, by the names in ``metrics``, in the order of the test split.
        curves: means over the clips at each predicted frame, as in curves.json.
    """

    metrics: dict[str, float]
    reasons: dict[str, str]
    shown: dict[str, np.ndarray]
    per_clip: dict[str, list[float]] = field(default_factory=dict)
    curves: Curves = field(default_factory=dict)


def check_files(settings: EvalConfig) -> None:
    """Checks the files of weights that metrics need, so that a run does not train for hours first.

    Raises:
        UserError: one is missing, damaged or of another network.
    """
    for path, net in ((settings.lpips_alex_weights, "alexnet"), (settings.lpips_vgg_weights, "vgg16")):
        if path:
            load_lpips(path, net)
    choose_estimator(settings)


def evaluate(trained: TrainedModel, store: Store) -> Evaluation:
    """Scores a model on the test split, and two baselines: repeating the last prompt frame, and reconstruction.

    Args:
        store: the clips of the run; the test split is scored, the train split determines the range of
            uniform random actions.

    Raises:
        StoreError: a test clip is damaged.
        UserError: a file of weights is missing, damaged or of another network, or the depth estimator cannot run.
    """
    source, config = store.source("test"), trained.config
    check_files(config.eval)
    estimator = choose_estimator(config.eval, load=True)
    numbers = spread(source, config.eval.clips)
    records = [source[number] for number in numbers]
    clips = Clips.stacked(records, numbers)
    videos = _generate_all(trained, clips, store)
    scenes = _scenes(trained, clips, videos, estimator, _locate(trained, store, records))

    scores: dict[str, float] = {}
    reasons: dict[str, str] = {}
    per_clip: dict[str, PerClip] = {}
    for metric in metrics().values():
        try:
            scored = _score(metric, scenes)
        except Unavailable as reason:
            reasons[metric.name] = str(reason)
        else:
            scores |= _summarised(metric, scored)
            per_clip |= {name: values for name, values in scored.items() if values.ndim}
    scores["clips"] = float(len(clips.rgb))
    if (share := store.manifest.get("success_share")) is not None:
        scores["success_share"] = float(share)
    shown = shown_arrays(clips, scenes, per_clip["psnr"], config.eval.report_clips)
    rows = {name: values.tolist() for name, values in per_clip.items()}
    return Evaluation(scores, reasons, shown, rows, frame_curves(scenes))


def _generate_all(trained: TrainedModel, clips: Clips, store: Store) -> dict[str, list[Video]]:
    """Generates videos under the clips' own actions and under every draw of others, by kind."""
    draws = _draws(trained, clips.actions, store)
    total = sum(map(len, draws.values())) * len(clips.rgb)
    videos: dict[str, list[Video]] = {}
    with Progress("evaluation", total, "rollouts") as progress:
        done = 0
        for kind, sequences in draws.items():
            for actions in sequences:
                videos.setdefault(kind, []).append(_generate(trained, clips, actions, depth=kind == "own"))
                progress.update(done := done + len(clips.rgb))
    return videos


def _draws(trained: TrainedModel, actions: Float[np.ndarray, "B T A"], store: Store) -> dict[str, np.ndarray]:
    """Returns the actions to generate under by kind, each (R, B, T, A)."""
    draws, train = trained.config.eval.action_draws, store.source("train")
    low, high = delta_psnr.action_range(
        np.stack([clip["actions"] for _, clip in readable(train, spread(train, RANGE_CLIPS))])
    )
    return {
        "own": actions[None],
        "other": actions[delta_psnr.other_clips(len(actions), draws, seed=0)],
        "uniform": delta_psnr.uniform_actions(actions, low, high, draws, seed=0),
    }


def _generate(trained: TrainedModel, clips: Clips, actions: np.ndarray, depth: bool) -> Video:
    """Generates the videos of all clips in batches of one shape, so that one program is compiled."""
    size, prompt = trained.config.eval.batch_size, clips.video.frames(0, trained.config.prompt_frames)
    parts = []
    for rows in _batches(len(actions), size):
        inputs = (trained.params, trained.assets, prompt[rows], actions[rows])
        parts.append(trained.model.generate(*inputs, index=clips.index[rows], depth=depth))
    rgb = np.concatenate([part.rgb for part in parts])[: len(actions)]
    if all(part.depth is None for part in parts):
        return Video(rgb)
    unknown = [np.full(part.rgb.shape[:-1], np.nan, np.float32) if part.depth is None else part.depth for part in parts]
    return Video(rgb, np.concatenate(unknown)[: len(actions)])


def _teacher_forced(trained: TrainedModel, clips: Clips) -> TeacherForced | None:
    """Predicts every frame of all clips from the true frames before it; None if the model cannot."""
    parts = []
    for rows in _batches(len(clips.rgb), trained.config.eval.batch_size):
        inputs = (trained.params, trained.assets, clips.video[rows], clips.actions[rows])
        parts.append(trained.model.teacher_forced(*inputs, trained.config.prompt_frames))
    if any(part is None for part in parts):
        return None

    def joined(name: str) -> dict[str, np.ndarray]:
        fields = [getattr(part, name) for part in parts]
        return {branch: np.concatenate([field[branch] for field in fields])[: len(clips.rgb)] for branch in fields[0]}

    return TeacherForced(joined("cross_entropy"), joined("accuracy"))


def _batches(clips: int, size: int) -> Iterator[Int[np.ndarray, " size"]]:
    """Yields the numbers of all clips in batches of one size, the last filled up, so that one program is compiled."""
    for start in range(0, clips, size):
        yield np.minimum(np.arange(start, start + size), clips - 1)


def _locate(trained: TrainedModel, store: Store, records: Sequence[Record]) -> Callable[[Video, bool], Located] | None:
    """Trains a localiser and returns a function that compares its reading of a video's last frames with the truth.

    None if the clips do not record where things are.
    """
    recorded, train = recorded_places(records), store.source("train")
    if recorded is None:
        return None
    places, width = recorded
    last = Places(places.xy[:, -1], places.lifted[:, -1])
    clips = [clip for _, clip in readable(train, spread(train, LOCALISER_CLIPS))]
    localiser = train_localiser(clips, trained.config.eval.localiser_steps)
    on_truth = localiser(np.stack([record["rgb"][-1] for record in records]))
    return lambda video, own: Located(last, width, on_truth if own else None, localiser(video.rgb[:, -1]))


def _scenes(
    trained: TrainedModel,
    clips: Clips,
    videos: dict[str, list[Video]],
    estimator: DepthEstimator | None,
    locate: Callable[[Video, bool], Located] | None,
) -> dict[str, Scene]:
    """Returns the prediction's scene as "", and those of both baselines by their suffix of names."""
    settings, prompt, truth = trained.config.eval, trained.config.prompt_frames, clips.metric_video
    alternatives = dict(videos)
    shown = {"": alternatives.pop("own")[0], "_repeat_first": _repeat_first(truth, prompt)}
    if (reconstruction := trained.model.reconstruct(trained.assets, clips.video)) is not None:
        shown["_tokenizer"] = reconstruction
    rgb = {suffix: video.rgb for suffix, video in shown.items()}
    estimated = estimate_depth(estimator, truth.rgb, rgb) if estimator else {}
    teacher_forced = _teacher_forced(trained, clips)
    truth_cache: dict[Any, Any] = {}
    return {
        suffix: Scene(
            truth,
            video,
            prompt,
            {} if suffix else alternatives,
            estimated.get(suffix),
            locate(video, not suffix) if locate else None,
            None if suffix else teacher_forced,
            settings=settings,
            truth_cache=truth_cache,
        )
        for suffix, video in shown.items()
    }


def _score(metric: Metric, scenes: dict[str, Scene]) -> dict[str, PerClip]:
    """Scores the clips of the prediction and of both baselines with a metric, by name.

    Raises:
        Unavailable: the prediction cannot be scored. A baseline that cannot is left out.
    """
    scores = _named(metric, scenes[""], "")
    for suffix in filter(None, scenes if not metric.needs else ()):
        with suppress(Unavailable):
            scores |= _named(metric, scenes[suffix], suffix)
    return scores


def _named(metric: Metric, scene: Scene, suffix: str) -> dict[str, PerClip]:
    assert metric.function is not None
    scored = metric.function(scene)
    parts = scored if isinstance(scored, dict) else {"": scored}
    return {f"{metric.name}{suffix}{part}": np.asarray(per_clip) for part, per_clip in parts.items()}


def _summarised(metric: Metric, per_clip: dict[str, PerClip]) -> dict[str, float]:
    """Returns the mean or median over clips of each score, and its interval."""
    flat: dict[str, float] = {}
    for name, values in per_clip.items():
        if not values.ndim:  # one number for all clips
            flat[name] = float(values)
            continue
        estimate = bootstrap(values, statistic=metric.statistic)
        flat |= estimate.flat(name) if metric.interval else {name: estimate.value}
    return flat | ({f"{metric.name}_repeat_first": 0.0} if metric.needs else {})  # this baseline ignores actions


def _repeat_first(video: Video, prompt_frames: int) -> Video:
    """Returns the last prompt frame repeated for the whole video: the baseline without motion."""
    last, frames = video.frames(prompt_frames - 1, prompt_frames), video.rgb.shape[1]
    return Video(np.repeat(last.rgb, frames, 1), None if last.depth is None else np.repeat(last.depth, frames, 1))


def save(path: Path, result: Evaluation) -> None:
    """Writes a result atomically."""
    values = {name: getattr(result, name) for name in ("metrics", "reasons", "per_clip", "curves")}
    write_atomically(path, encode(values | result.shown))


def load(path: Path) -> Evaluation:
    """Reads a result written by :func:`save`.

    Raises:
        StoreError: the file is damaged.
    """
    try:
        record = decode(path.read_bytes())
    except ValueError as error:
        raise StoreError(f"{path}: damaged ({error}); delete it and run again") from error
    metrics, reasons = record.pop("metrics"), record.pop("reasons")
    # Files of earlier versions have neither of these two.
    per_clip, curves = record.pop("per_clip", {}), record.pop("curves", {})
    return Evaluation(metrics, reasons, record, per_clip, curves)
