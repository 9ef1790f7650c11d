"""Evaluates a world model: generates videos from the first frames of held-out clips and scores all registered metrics.

Reading order: :func:`evaluate` generates the videos (:mod:`rsjax.evaluation.generation`), pairs them with the recorded
ones as scenes (:func:`make_scenes`), scores every metric of the registry (:func:`score_all`, :func:`frame_curves`),
and summarises the clips' scores (:func:`summarised`).

Axes: B clips, T frames, H×W pixels, A action dimensions, R draws of random actions.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rsjax.clip import Video
from rsjax.config import EvalConfig
from rsjax.config.data import ClipShape
from rsjax.data.clips import Clips, readable, spread
from rsjax.data.codec import Record
from rsjax.data.state_labels import STATE, knows_success
from rsjax.data.store import Store, StoreError
from rsjax.devices import replicate
from rsjax.errors import UserError
from rsjax.evaluation.coverage import Coverage
from rsjax.evaluation.depth_estimator import DepthEstimator, estimate_depth
from rsjax.evaluation.generation import OWN, Generation, teacher_forced, with_baselines
from rsjax.evaluation.localiser import Localiser, recorded_places, train_localiser
from rsjax.evaluation.metrics import contact, delta_psnr, drive, fvd
from rsjax.evaluation.metrics.lpips import check_lpips
from rsjax.evaluation.probes import Probes, probe, with_probes
from rsjax.evaluation.protocols import Protocol, check, of_run
from rsjax.evaluation.registry import (
    NO_PROBES,
    Familiarity,
    Located,
    Metric,
    PerClip,
    PerFrame,
    Places,
    Probed,
    Scene,
    Unavailable,
    metrics,
)
from rsjax.evaluation.results import Curves, Evaluation
from rsjax.evaluation.shown import kept_frames, shown_arrays
from rsjax.evaluation.statistics import bootstrap
from rsjax.models.base import TeacherForced
from rsjax.models.trained import TrainedModel

RANGE_CLIPS = 1000  # training clips that determine the range of uniform random actions
LOCALISER_CLIPS = 1000  # training clips from which the localiser learns
PIXELS = ("psnr", "ssim", "lpips_alex", "lpips_vgg")  # metrics that are also reduced to the best of several samples
CURVE_RESAMPLES = 2000  # bootstrap resamples of the clips at each frame

Locate = Callable[[Video, bool], Located]


def check_files(settings: EvalConfig) -> None:
    """Checks the weight files that metrics need, so that a run does not fail after hours of training.

    Raises:
        UserError: their directory is missing, or a file is damaged or of another network.
    """
    check_lpips(settings)
    fvd.check_i3d(settings)


@dataclass(frozen=True)
class EvaluationClips:
    """The clips of one split that a protocol scores.

    Attributes:
        protocol: with its horizon and resolution as numbers.
        records: the records of the scored clips, in full length.
        clips: the same clips, cut to the protocol's frames.
        retakes: second recordings of the same scenes, cut in the same way; None if there are none.
    """

    store: Store
    split: str
    protocol: Protocol
    records: Sequence[Record]
    clips: Clips
    retakes: Video | None = None

    @classmethod
    def read(cls, store: Store, split: str, protocol: Protocol, shape: ClipShape) -> "EvaluationClips":
        """Reads the clips.

        Args:
            shape: of the clips that the model learned from.

        Raises:
            StoreError: there is no such split, it has fewer than two clips, a clip is damaged, or the size of its
                frames or actions is not the model's.
            UserError: the clips are shorter or smaller than the protocol needs.
        """
        source = store.source(split)
        where = f"the {split} split of {store.path}"
        numbers = spread(source, protocol.clips)
        if len(numbers) < 2:
            raise StoreError(f"{where} has {len(numbers)} clips; an evaluation takes two at least: name another split")
        records = [source[number] for number in numbers]
        frames, size = records[0]["rgb"].shape[:2]
        actions = records[0]["actions"].shape[1]
        if (size, actions) != (shape.image_size, shape.action_dim):
            raise StoreError(
                f"{where} has frames of {size} pixels per side and {actions} numbers an action; the model takes "
                f"{shape.image_size} and {shape.action_dim}: name clips that were made alike"
            )
        protocol = check(protocol, frames, size, where)
        clips = Clips.stacked(records, numbers).first(protocol.prompt_frames + protocol.horizon)
        if not knows_success(store):
            clips.state[..., STATE.index("success")] = np.nan
        return cls(store, split, protocol, records, clips)

    def ids(self) -> list[dict[str, Any]]:
        """Returns what identifies each clip: its number in the split, its episode, and a hash of frames and actions."""
        ids = []
        for number, record in zip(self.clips.index, self.records, strict=True):
            content = hashlib.sha256(record["rgb"].tobytes() + record["actions"].tobytes()).hexdigest()[:16]
            ids.append({"number": int(number), "episode": record["provenance"].get("episode"), "sha256": content})
        return ids


def evaluate(
    trained: TrainedModel,
    store: Store,
    protocol: Protocol | None = None,
    eval_clips: EvaluationClips | None = None,
    folder: Path | None = None,
    estimator: DepthEstimator | None = None,
    probes: Probes | Unavailable = NO_PROBES,
    coverage: Coverage | None = None,
) -> Evaluation:
    """Scores a model and two baselines on held-out clips: the last prompt frame repeated, and the reconstruction.

    Args:
        store: the clips of the run; the train split determines the range of uniform random actions. A saved model's few
            clips have none, and no scores that need it.
        protocol: the protocol to evaluate by; None: that of the run's own configuration.
        eval_clips: the clips to score; None: those of the store's test split.
        folder: where generated batches are kept until the evaluation is finished; None: in memory.
        estimator: estimates depth from frames; None: no scores of estimated depth.
        probes: episodes of the clips' simulator that test contacts and free driving, or why there are none.
        coverage: the bank of training clips; None: distances from them are not scored.

    Raises:
        StoreError: a test clip is damaged.
        UserError: a weight file is missing, damaged or of another network, or the depth estimator cannot run.
    """
    settings = trained.config.eval
    check_files(settings)
    if eval_clips is None:
        eval_clips = EvaluationClips.read(store, "test", protocol or of_run(trained.config), trained.config.clips)
    protocol = eval_clips.protocol
    clips = eval_clips.clips
    generation = plan(trained, store, eval_clips, folder)
    generation.make()

    localiser = localiser_of(settings, store, eval_clips.records)
    locate = None if localiser is None else locating(localiser, eval_clips.records, clips.rgb.shape[1] - 1)
    probed: Mapping[str, Probed] | Unavailable = NO_PROBES
    if isinstance(probes, Unavailable):
        probed = probes
    elif localiser is not None:
        probed = probe(generation.trained, localiser, probes, protocol, folder)
    predicted_tokens = teacher_forced(generation.trained, protocol.prompt_frames, clips.video, clips.actions)
    familiarity = None
    if coverage is not None and predicted_tokens is not None and predicted_tokens.features is not None:
        distances = coverage.distances(predicted_tokens.features, clips.actions[:, protocol.prompt_frames :])
        familiarity = Familiarity(*coverage.of_clips(distances.mean(1)))
    takes_actions = trained.config.model.takes_actions
    first = make_scenes(
        generation.trained,
        protocol,
        clips,
        generation.videos(0),
        estimator,
        locate,
        predicted_tokens,
        eval_clips.retakes,
        familiarity,
    )
    first = with_probes(first, probed)
    scored = score_all(first, protocol, takes_actions)
    repetitions = [with_best(scored, first[""], generation.samples(0), protocol)]
    curves = [frame_curves(first)]
    for run in range(1, protocol.repetitions):
        scene = next_scene(first[""], generation.videos(run), protocol, estimator, locate)
        again = with_baselines_of(scored, score_all({"": scene}, protocol, takes_actions), first)
        repetitions.append(with_best(again, scene, generation.samples(run), protocol))
        curves.append(frame_curves(first | {"": scene}))

    scored = mean_scores(repetitions)
    per_clip = scored.per_clip()
    scores = summarised(scored)
    scores["clips"] = float(len(clips.rgb))
    success_share = eval_clips.store.manifest.get("success_share")
    if success_share is not None:
        scores["success_share"] = float(success_share)
    return Evaluation(
        metrics=scores,
        reasons=scored.reasons,
        shown=shown_arrays(clips, first, per_clip["psnr"]),
        per_clip={name: values.tolist() for name, values in per_clip.items()},
        curves=mean_curves(curves),
        repetitions=[summarised(each, interval=False) for each in repetitions],
        clips=eval_clips.ids(),
        kept=kept_frames(first, per_clip["psnr_repeat_first"]),
    )


def plan(trained: TrainedModel, store: Store, eval_clips: EvaluationClips, folder: Path | None = None) -> Generation:
    """Returns the generation of all videos of an evaluation; several processes can each make a share of them."""
    assets = trained.assets
    if assets.tokenizer is not None:
        assets = replace(assets, tokenizer=replicate(assets.tokenizer))
    trained = replace(trained, params=replicate(trained.params), assets=assets)
    protocol = eval_clips.protocol
    clips = eval_clips.clips
    draws = {OWN: clips.actions[None]}
    if protocol.action_draws and trained.config.model.takes_actions:
        draws["other"] = clips.actions[delta_psnr.other_clips(len(clips.actions), protocol.action_draws, seed=0)]
        if "train" in store.splits:
            train = store.source("train")
            recorded = [clip["actions"] for _, clip in readable(train, spread(train, RANGE_CLIPS))]
            low, high = delta_psnr.action_range(np.stack(recorded))
            draws["uniform"] = delta_psnr.uniform_actions(clips.actions, low, high, protocol.action_draws, seed=0)
    if protocol.samples > 1:
        truth = scored_frames(trained, protocol, clips)
    else:
        truth = clips.video
    return Generation(
        trained,
        protocol,
        clips,
        draws,
        len(eval_clips.store.source(eval_clips.split)),
        lambda rows, video: sample_scores(truth[rows], video, protocol, trained.config.eval),
        folder,
    )


# What metrics compare: recorded videos with the prediction and both baselines, at the protocol's resolution.


def make_scenes(
    trained: TrainedModel,
    protocol: Protocol,
    clips: Clips,
    videos: Mapping[str, Sequence[Video]],
    estimator: DepthEstimator | None,
    locate: Locate | None,
    predicted_tokens: TeacherForced | None = None,
    retakes: Video | None = None,
    familiarity: Familiarity | None = None,
) -> dict[str, Scene]:
    """Returns the scenes by the suffix that names their scores: "" for the prediction, and one for each baseline.

    Args:
        videos: by kind of actions, one for each draw; the first under the clips' own actions is the prediction.
        predicted_tokens: how well the model predicts tokens from true frames.
        retakes: second recordings of the clips' scenes.
        familiarity: how far the clips are from the training clips.
    """
    shown = with_baselines(trained, clips, videos[OWN][0], protocol.prompt_frames)
    truth = scored_frames(trained, protocol, clips, shown.get("_tokenizer"))
    compared = {suffix: scaled(video, protocol.resolution) for suffix, video in shown.items()}
    estimated = {}
    if estimator is not None:
        estimated = estimate_depth(estimator, truth.rgb, {suffix: video.rgb for suffix, video in compared.items()})
    if retakes is not None:
        retakes = scaled(retakes, protocol.resolution)
    truth_cache: dict[Any, Any] = {}
    scenes = {}
    for suffix, video in compared.items():
        scenes[suffix] = Scene(
            truth,
            video,
            protocol.prompt_frames,
            estimated=estimated.get(suffix),
            second_take=retakes,
            as_published=protocol.as_published,
            settings=trained.config.eval,
            truth_cache=truth_cache,
        )
        if locate is not None:
            scenes[suffix] = replace(scenes[suffix], located=locate(shown[suffix], suffix == ""))
    scenes[""] = replace(
        scenes[""],
        alternatives=other_videos(videos, protocol),
        teacher_forced=predicted_tokens,
        familiarity=familiarity,
    )
    return scenes


def next_scene(
    first: Scene,
    videos: Mapping[str, Sequence[Video]],
    protocol: Protocol,
    estimator: DepthEstimator | None,
    locate: Locate | None,
) -> Scene:
    """Returns the scene of another repetition's prediction; the baselines' are the same in all repetitions.

    Args:
        first: that of the first repetition's prediction.
        videos: of the repetition, as for :func:`make_scenes`.
    """
    made = videos[OWN][0]
    prediction = scaled(made, protocol.resolution)
    scene = replace(first, prediction=prediction, alternatives=other_videos(videos, protocol))
    if estimator is not None:
        scene = replace(scene, estimated=estimate_depth(estimator, first.truth.rgb, {"": prediction.rgb})[""])
    if locate is not None:
        scene = replace(scene, located=locate(made, True))
    return scene


def other_videos(videos: Mapping[str, Sequence[Video]], protocol: Protocol) -> dict[str, list[Video]]:
    """Returns the videos under other actions than the clips' own, as they are compared."""
    others = {kind: draws for kind, draws in videos.items() if kind != OWN}
    return {kind: [scaled(video, protocol.resolution) for video in draws] for kind, draws in others.items()}


def scored_frames(
    trained: TrainedModel, protocol: Protocol, clips: Clips, reconstruction: Video | None = None
) -> Video:
    """Returns what predictions are compared with: recorded frames or their reconstruction, with recorded depth.

    Raises:
        UserError: the protocol compares with reconstructions, and the model has no tokenizer.
    """
    truth = clips.metric_video
    if protocol.reference == "reconstruction":
        if reconstruction is None:
            reconstruction = trained.model.reconstruct(trained.assets, clips.video)
        if reconstruction is None:
            raise UserError(
                f"protocol {protocol.name} compares with the tokenizer's reconstruction, and a model of family "
                f"{trained.config.model.family!r} has no tokenizer; choose another protocol"
            )
        truth = replace(truth, rgb=reconstruction.rgb)
    return scaled(truth, protocol.resolution)


def localiser_of(settings: EvalConfig, store: Store, records: Sequence[Record]) -> Localiser | None:
    """Trains the network that reads where cube and gripper are; returns None if the clips do not record it.

    Args:
        store: the store of the run; the localiser learns from its training clips, if there are any.
        records: the scored clips.
    """
    if recorded_places(records) is None or "train" not in store.splits:
        return None
    train = store.source("train")
    clips = [clip for _, clip in readable(train, spread(train, LOCALISER_CLIPS))]
    if recorded_places(clips) is None:
        return None
    return train_localiser(clips, settings.localiser_steps)


def locating(localiser: Localiser, records: Sequence[Record], last: int) -> Locate:
    """Returns a function that pairs the localiser's reading of a video's last frames with the truth.

    Args:
        records: the scored clips, which record places.
        last: the index of the last frame that is scored.
    """
    recorded = recorded_places(records)
    assert recorded is not None
    places, width = recorded
    truth = Places(places.xy[:, last], places.lifted[:, last])
    on_truth = localiser(np.stack([record["rgb"][last] for record in records]))

    def locate(video: Video, own: bool) -> Located:
        return Located(truth, width, on_truth if own else None, localiser(video.rgb[:, -1]))

    return locate


def scaled(video: Video, side: int) -> Video:
    """Returns a video resized to ``side`` pixels per side: RGB by area means, depth by nearest neighbour."""
    if video.rgb.shape[2] == side:
        return video
    lead = video.rgb.shape[:2]
    rgb = [cv2.resize(frame, (side, side), interpolation=cv2.INTER_AREA) for frame in np.concatenate(video.rgb)]
    small = replace(video, rgb=np.stack(rgb).reshape(*lead, side, side, 3))
    if video.depth is None:
        return small
    depth = [cv2.resize(frame, (side, side), interpolation=cv2.INTER_NEAREST) for frame in np.concatenate(video.depth)]
    return replace(small, depth=np.stack(depth).reshape(*lead, side, side))


# The scores of all metrics: over clips, over repetitions, and for the best of several samples.


@dataclass(frozen=True)
class ClipScores:
    """The clips' scores, and the reasons for missing scores.

    Attributes:
        values: metric → name in metrics.json → each clip's score, or one score of the whole set as an array without
            axes; for the prediction and for both baselines.
        reasons: why a registered metric has no score, by name.
        best: scores of the best of several samples, by name.
    """

    values: Mapping[str, Mapping[str, PerClip]]
    reasons: dict[str, str]
    best: Mapping[str, PerClip]

    def per_clip(self) -> dict[str, PerClip]:
        """Returns the clips' scores by name, without scores of the whole set."""
        scores: dict[str, PerClip] = {}
        for values in self.values.values():
            scores |= values
        scores |= self.best
        return {name: each for name, each in scores.items() if each.ndim}


def score_all(scenes: Mapping[str, Scene], protocol: Protocol, takes_actions: bool = True) -> ClipScores:
    """Scores the prediction and both baselines with all registered metrics.

    Args:
        takes_actions: False for a model without actions, which metrics that need other actions cannot score.
    """
    values = {}
    reasons = {}
    for metric in metrics().values():
        try:
            if metric.needs and not takes_actions:
                raise Unavailable("the model takes no actions")
            values[metric.name] = _score(metric, scenes, protocol)
        except Unavailable as reason:
            reasons[metric.name] = str(reason)
    return ClipScores(values, reasons, {})


def with_baselines_of(known: ClipScores, scored: ClipScores, suffixes: Iterable[str]) -> ClipScores:
    """Adds the baselines' scores of another repetition to those of a prediction alone.

    Args:
        known: the other repetition's.
        suffixes: of the scores' names, "" for the prediction.
    """
    values = {}
    for metric, own in scored.values.items():
        starts = tuple(f"{metric}{suffix}" for suffix in suffixes if suffix)
        theirs = {name: each for name, each in known.values.get(metric, {}).items() if name.startswith(starts)}
        values[metric] = theirs | dict(own)
    return replace(scored, values=values)


def _score(metric: Metric, scenes: Mapping[str, Scene], protocol: Protocol) -> dict[str, PerClip]:
    """Returns a metric's scores of the prediction and of both baselines, by name.

    Raises:
        Unavailable: the prediction cannot be scored. A baseline that cannot be scored is left out.
    """
    if not scenes[""].alternatives.keys() >= set(metric.needs):
        if scenes[""].alternatives:
            raise Unavailable("there are no training clips, which give the range of random actions")
        raise Unavailable(f"protocol {protocol.name} generates no videos under other actions")
    scores = _named(metric, scenes[""], "")
    if metric.needs:  # the first frame repeated ignores actions
        still = f"{metric.name}_repeat_first"
        return scores | {still + name.removeprefix(metric.name): np.zeros_like(each) for name, each in scores.items()}
    for suffix in filter(None, scenes):
        with suppress(Unavailable):
            scores |= _named(metric, scenes[suffix], suffix)
    return scores


def _named(metric: Metric, scene: Scene, suffix: str) -> dict[str, PerClip]:
    assert metric.function is not None
    scored = metric.function(scene)
    parts = scored if isinstance(scored, dict) else {"": scored}
    return {f"{metric.name}{suffix}{part}": np.asarray(per_clip) for part, per_clip in parts.items()}


def sample_scores(truth: Video, video: Video, protocol: Protocol, settings: EvalConfig) -> dict[str, PerClip]:
    """Scores one sample of each clip with the pixel metrics, over all frames: prompt frames as the model sees them."""
    scene = Scene(truth, scaled(video, protocol.resolution), 0, settings=settings)
    scores = {}
    for name in PIXELS:
        with suppress(Unavailable):
            scores[name] = _named(metrics()[name], scene, "")[name]
    return scores


def with_best(
    scored: ClipScores, scene: Scene, samples: Sequence[Mapping[str, PerClip]], protocol: Protocol
) -> ClipScores:
    """Adds the best score over all samples for each pixel metric; adds nothing if there is only one sample.

    ``NAME_best100_incl_ctx`` takes each clip's best sample separately for each metric, over all frames, as iVideoGPT
    does; ``NAME_n1_pred_only`` is the first sample's score over the predicted frames only.

    Args:
        scene: with the first sample as its prediction.
        samples: the scores of the further samples.
    """
    if not samples:
        return scored
    first = sample_scores(scene.truth, scene.prediction, protocol, scene.settings)
    best = {}
    for name, values in first.items():
        reduce = np.max if metrics()[name].better == "higher" else np.min
        everything = np.stack([values, *(sample[name] for sample in samples)])
        best[f"{name}_best{len(everything)}_incl_ctx"] = reduce(everything, axis=0)
        best[f"{name}_n1_pred_only"] = scored.values[name][name]
    return ClipScores(scored.values, scored.reasons, best)


def mean_scores(repetitions: Sequence[ClipScores]) -> ClipScores:
    """Returns each clip's mean scores over repetitions with different random draws."""
    if len(repetitions) == 1:
        return repetitions[0]

    def mean(maps: Sequence[Mapping[str, PerClip]]) -> dict[str, PerClip]:
        names = [
            name for name in maps[0] if all(name in each for each in maps)
        ]  # a correlation may be undefined in one
        return {name: np.mean([each[name] for each in maps], axis=0) for name in names}

    values = {name: mean([each.values[name] for each in repetitions]) for name in repetitions[0].values}
    return ClipScores(values, repetitions[0].reasons, mean([each.best for each in repetitions]))


def summarised(scored: ClipScores, interval: bool = True) -> dict[str, float]:
    """Returns each score's mean or median over clips by name, and its interval as ``NAME_low`` and ``NAME_high``."""
    flat: dict[str, float] = {}
    for metric in (metrics()[name] for name in scored.values):
        for name, values in scored.values[metric.name].items():
            if not values.ndim:  # one number for all clips
                flat[name] = float(values)
                continue
            estimate = bootstrap(values, statistic=metric.statistic)
            flat |= estimate.flat(name) if metric.interval and interval else {name: estimate.value}
    for name, values in scored.best.items():
        estimate = bootstrap(values)
        flat |= estimate.flat(name) if interval else {name: estimate.value}
    return flat


# Curves over the predicted frames: the mean over clips at each frame, with a bootstrap band.


def frame_curves(scenes: Mapping[str, Scene]) -> Curves:
    """Returns the curves of all metrics that score single frames, for every scene; ``scenes`` is keyed by suffix."""
    prompt = scenes[""].prompt_frames
    frames = scenes[""].truth.rgb.shape[1]
    curves: Curves = {"frame": list(range(prompt + 1, frames + 1))}
    curves |= drive.axis(scenes[""]) | contact.success_curves(scenes[""])
    for metric in metrics().values():
        if metric.per_frame is None:
            continue
        for suffix, scene in scenes.items():
            if not scene.alternatives.keys() >= set(metric.needs):
                continue  # a baseline has no videos under other actions
            with suppress(Unavailable):
                curves |= _curve(f"{metric.name}{suffix}", metric, scene.shared(metric.per_frame))
    return curves


def _curve(name: str, metric: Metric, per_frame: PerFrame) -> Curves:
    """Returns a curve and both edges of its band; at each frame, clips without a score do not count."""
    curve: Curves = {name: [], f"{name}_low": [], f"{name}_high": []}
    for values in np.asarray(per_frame).T:
        known = values[np.isfinite(values)]
        at: dict[str, float] = {}
        if known.size:
            at = bootstrap(known, resamples=CURVE_RESAMPLES, statistic=metric.statistic).flat(name)
        for key, points in curve.items():
            points.append(at.get(key))
    return curve


def mean_curves(repetitions: Sequence[Curves]) -> Curves:
    """Returns the mean of curves over repetitions, point by point; a band's edges are the means of the edges."""
    if len(repetitions) == 1:
        return repetitions[0]
    mean: Curves = {}
    for name in repetitions[0]:
        mean[name] = []
        for points in zip(*(curves[name] for curves in repetitions), strict=True):
            known = [point for point in points if point is not None]
            mean[name].append(float(np.mean(known)) if known else None)
    return mean
