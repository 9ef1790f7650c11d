"""Evaluates a world model: generates videos from the first frames of held-out clips and scores all registered metrics.

Axes: B clips, T frames, H×W pixels, A action dimensions, R draws of random actions.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rsjax.clip import Video
from rsjax.config import EvalConfig
from rsjax.config.data import ClipShape
from rsjax.data.clips import Clips, readable, spread
from rsjax.data.codec import Record, decode, encode
from rsjax.data.store import Store, StoreError
from rsjax.devices import replicate
from rsjax.evaluation.depth_estimator import DepthEstimator
from rsjax.evaluation.frame_curves import Curves, frame_curves
from rsjax.evaluation.generation import OWN, Generation, teacher_forced
from rsjax.evaluation.metrics import delta_psnr, fvd
from rsjax.evaluation.protocols import Protocol, check, of_run
from rsjax.evaluation.registry import PerClip, Scene
from rsjax.evaluation.scenes import locating, make_scenes, scored_frames
from rsjax.evaluation.scoring import Scored, mean_curves, mean_scores, sample_scores, score_all, summarised, with_best
from rsjax.evaluation.shown import extremes, shown_arrays
from rsjax.files import write_atomically
from rsjax.models.base import Assets
from rsjax.models.trained import TrainedModel
from rsjax.tokenizers.lpips import load_lpips

RANGE_CLIPS = 1000  # training clips that determine the range of uniform random actions
KEPT_CLIPS = 24  # clips whose frames are kept for comparisons, spread evenly; those of :func:`extremes` are added


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation.

    Attributes:
        metrics: scores by name.
        reasons: why a registered metric has no score, by name.
        shown: arrays of the clips in the report, with a leading axis over clips.
        per_clip: the score of each scored clip, by the names in ``metrics``, in the order of the split, without clips
            that have no score; the mean over repetitions if there are several.
        curves: means over the clips at each predicted frame, as in curves.json.
        repetitions: the scores of each repetition.
        clips: the scored clips: ``number`` in the split, ``episode`` if known, ``sha256`` of frames and actions.
        kept: frames of some of the scored clips: ``rows``, the rows of these clips; ``truth``, ``prediction``, and
            ``reconstruction`` by the tokenizer if the model has one, each (n, T, H, W, 3).
    """

    metrics: dict[str, float]
    reasons: dict[str, str]
    shown: dict[str, np.ndarray]
    per_clip: dict[str, list[float]] = field(default_factory=dict)
    curves: Curves = field(default_factory=dict)
    repetitions: list[dict[str, float]] = field(default_factory=list)
    clips: list[dict[str, Any]] = field(default_factory=list)
    kept: dict[str, np.ndarray] = field(default_factory=dict)


def check_files(settings: EvalConfig) -> None:
    """Checks the weight files that metrics need, so that a run does not fail after hours of training.

    Raises:
        UserError: a file is missing, damaged or of another network.
    """
    for path, net in ((settings.lpips_alex_weights, "alexnet"), (settings.lpips_vgg_weights, "vgg16")):
        if path:
            load_lpips(path, net)
    if settings.fvd_weights:
        fvd.check_i3d(settings.fvd_weights)


@dataclass(frozen=True)
class HeldOut:
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
    def read(cls, store: Store, split: str, protocol: Protocol, shape: ClipShape) -> "HeldOut":
        """Reads the clips.

        Args:
            shape: of the clips that the model learned from.

        Raises:
            StoreError: there is no such split, it has fewer than two clips, a clip is damaged, or the size of its
                frames or actions is not the model's.
            UserError: the clips are shorter or smaller than the protocol needs.
        """
        source, where = store.source(split), f"the {split} split of {store.path}"
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
        return cls(store, split, protocol, records, clips)

    def ids(self) -> list[dict[str, Any]]:
        """Returns what identifies each clip: its number in the split, its episode, and a hash of frames and actions."""
        return [
            {"number": int(number), "episode": record["provenance"].get("episode"), "sha256": _hash(record)}
            for number, record in zip(self.clips.index, self.records, strict=True)
        ]


def _hash(record: Record) -> str:
    return hashlib.sha256(record["rgb"].tobytes() + record["actions"].tobytes()).hexdigest()[:16]


def evaluate(
    trained: TrainedModel,
    store: Store,
    protocol: Protocol | None = None,
    held_out: HeldOut | None = None,
    folder: Path | None = None,
    estimator: DepthEstimator | None = None,
) -> Evaluation:
    """Scores a model and two baselines on held-out clips: the last prompt frame repeated, and the reconstruction.

    Args:
        store: the clips of the run; the train split determines the range of uniform random actions.
        protocol: the protocol to evaluate by; None: that of the run's own configuration.
        held_out: the clips to score; None: those of the store's test split.
        folder: where generated batches are kept until the evaluation is finished; None: in memory.
        estimator: estimates depth from frames; None: no such scores.

    Raises:
        StoreError: a test clip is damaged.
        UserError: a weight file is missing, damaged or of another network, or the depth estimator cannot run.
    """
    settings = trained.config.eval
    check_files(settings)
    if held_out is None:
        wanted = protocol or of_run(trained.config)
        held_out = HeldOut.read(store, "test", wanted, trained.config.clips)
    generation = plan(trained, store, held_out, folder)
    generation.make()
    repetitions, first = _repetitions(generation, store, held_out, estimator)
    scored = mean_scores([scored for scored, _ in repetitions])
    scores = summarised(scored)
    scores["clips"] = float(len(held_out.clips.rgb))
    if (share := held_out.store.manifest.get("success_share")) is not None:
        scores["success_share"] = float(share)
    return Evaluation(
        scores,
        scored.reasons,
        shown_arrays(held_out.clips, first, scored.per_clip()["psnr"], settings.report_clips),
        {name: values.tolist() for name, values in scored.per_clip().items()},
        mean_curves([curves for _, curves in repetitions]),
        [summarised(each, interval=False) for each, _ in repetitions],
        held_out.ids(),
        _kept(first, scored.per_clip()["psnr_repeat_first"]),
    )


def _repetitions(
    generation: Generation, store: Store, held_out: HeldOut, estimator: DepthEstimator | None
) -> tuple[list[tuple[Scored, Curves]], dict[str, Scene]]:
    """Returns the scores of each repetition, and the scenes of the first one."""
    trained, clips, protocol = generation.trained, held_out.clips, held_out.protocol
    takes_actions = trained.config.model.takes_actions
    locate = locating(trained, store, held_out.records, clips.rgb.shape[1] - 1)
    taught, takes = teacher_forced(trained, protocol, clips), held_out.retakes
    repetitions: list[tuple[Scored, Curves]] = []
    first: dict[str, Scene] = {}
    for run in range(protocol.repetitions):
        scenes = make_scenes(trained, protocol, clips, generation.videos(run), estimator, locate, taught, takes)
        scored = with_best(score_all(scenes, protocol, takes_actions), scenes[""], generation.samples(run), protocol)
        repetitions.append((scored, frame_curves(scenes)))
        first = first or scenes
    return repetitions, first


def plan(trained: TrainedModel, store: Store, held_out: HeldOut, folder: Path | None = None) -> Generation:
    """Returns the generation of all videos of an evaluation; several processes can each make a share of them."""
    trained = replace(trained, params=replicate(trained.params), assets=_assets(trained.assets))
    clips, protocol = held_out.clips, held_out.protocol
    truth = scored_frames(trained, protocol, clips) if protocol.samples > 1 else clips.video
    return Generation(
        trained,
        protocol,
        clips,
        _draws(clips.actions, protocol.action_draws * trained.config.model.takes_actions, store),
        len(held_out.store.source(held_out.split)),
        lambda rows, video: sample_scores(truth[rows], video, protocol, trained.config.eval),
        folder,
    )


def _assets(assets: Assets) -> Assets:
    return assets if assets.tokenizer is None else replace(assets, tokenizer=replicate(assets.tokenizer))


def _draws(actions: Float[np.ndarray, "B T A"], draws: int, store: Store) -> dict[str, np.ndarray]:
    """Returns, by kind, the actions under which videos are generated, each (R, B, T, A)."""
    if not draws:
        return {OWN: actions[None]}
    train = store.source("train")
    low, high = delta_psnr.action_range(
        np.stack([clip["actions"] for _, clip in readable(train, spread(train, RANGE_CLIPS))])
    )
    return {
        OWN: actions[None],
        "other": actions[delta_psnr.other_clips(len(actions), draws, seed=0)],
        "uniform": delta_psnr.uniform_actions(actions, low, high, draws, seed=0),
    }


def _kept(scenes: dict[str, Scene], still: PerClip) -> dict[str, np.ndarray]:
    """Returns the frames of some clips: clips spread evenly, and those with the most and the least motion.

    The choice is the same for all models.

    Args:
        still: PSNR of the last prompt frame repeated, which does not depend on the model.
    """
    truth = scenes[""].truth.rgb
    rows = np.union1d(spread(truth, KEPT_CLIPS), np.concatenate(extremes(still)))
    arrays = {"rows": rows, "truth": truth[rows], "prediction": scenes[""].prediction.rgb[rows]}
    if "_tokenizer" in scenes:
        arrays["reconstruction"] = scenes["_tokenizer"].prediction.rgb[rows]
    return arrays


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
    # Files of earlier versions have neither of the following two.
    per_clip, curves = record.pop("per_clip", {}), record.pop("curves", {})
    return Evaluation(metrics, reasons, record, per_clip, curves)
