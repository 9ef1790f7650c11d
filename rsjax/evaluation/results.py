"""The results of evaluations and their files.

An :class:`Evaluation` is what :func:`rsjax.evaluation.evaluate.evaluate` returns. A :class:`Result` is the file
``result.json``: the scores and all that they depend on, so that only like results are ever compared.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import jax
import numpy as np

from rsjax.data.codec import decode, encode
from rsjax.data.store import StoreError
from rsjax.files import FileError, read_json, regular, write_atomically, write_file, write_json

NAME = "result.json"
FRAMES = "frames.msgpack"

# As in curves.json: "frame" holds the numbers of the predicted frames, counted from 1. The other keys are named as in
# metrics.json (psnr, psnr_low, psnr_high, psnr_repeat_first, …) and hold one number per predicted frame, None where no
# clip has a score.
Curves: TypeAlias = dict[str, list[float | None]]


@dataclass(frozen=True)
class Evaluation:
    """The scores of an evaluation, and the frames to show with them.

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


def save_evaluation(path: Path, evaluation: Evaluation) -> None:
    """Writes the scores and the frames of the report atomically."""
    values = {name: getattr(evaluation, name) for name in ("metrics", "reasons", "per_clip", "curves")}
    write_atomically(path, encode(values | evaluation.shown))


def load_evaluation(path: Path) -> Evaluation:
    """Reads what :func:`save_evaluation` wrote.

    Raises:
        StoreError: the file is damaged.
    """
    try:
        record = decode(regular(path).read_bytes())
        scores = {name: record.pop(name) for name in ("metrics", "reasons", "per_clip", "curves")}
    except (ValueError, KeyError) as error:
        raise StoreError(f"{path}: damaged ({error}); delete it and run again") from error
    return Evaluation(shown=record, **scores)


@dataclass(frozen=True)
class Result:
    """An evaluation as it is written to its file. All fields are JSON-ready.

    Attributes:
        label: the protocol's name with its changed fields.
        key: a key that changes with everything that determines the scores, except the code.
        protocol: every field of the protocol.
        sampling: all settings of sampling, some of which the protocol may fix; empty for a family without sampling.
        settings: those of the metrics; the files of metrics and depth estimator as a hash of their content.
            ``physics_iq_threshold``: grey levels of 255 above which a pixel moves.
        data: ``path``, ``key``, ``manifest_sha256``, ``split``, ``frames``, ``image_size`` and ``fps`` of the scored
            clips. ``fps``, in frames per second, is None if it is unknown.
        model: ``run``, ``preset``, ``family``, ``settings``, ``seed``, ``parameters`` and ``weights_sha256``;
            ``trained_on``, the key of the training data; ``training``, the settings of the training loops without
            seeds and starting points, and those of the tokenizer.
        code: version and git revision of rsjax.
        made: when (ISO 8601, UTC), and on which ``machine``.
        metrics: scores by name; None for a metric without a score, for which ``reasons`` says why.
        repetitions: the scores of each repetition.
        curves: as in curves.json.
        per_clip: the clips' scores by name, in the order of ``clips``, without clips that have no score, so the list is
            shorter where only some clips have depth or motion.
        clips: the scored clips: ``number`` in the split, ``episode``, ``sha256``.
    """

    label: str
    key: str
    protocol: dict[str, Any]
    sampling: dict[str, Any]
    settings: dict[str, Any]
    data: dict[str, Any]
    model: dict[str, Any]
    code: dict[str, Any]
    made: dict[str, Any]
    metrics: dict[str, float | None]
    reasons: dict[str, str]
    repetitions: list[dict[str, float]] = field(default_factory=list)
    curves: Curves = field(default_factory=dict)
    per_clip: dict[str, list[float]] = field(default_factory=dict)
    clips: list[dict[str, Any]] = field(default_factory=list)


def result_of(evaluation: Evaluation, **about: Any) -> Result:
    """Returns the file's content; ``about`` contains the fields that the evaluation itself does not know."""
    return Result(
        metrics=evaluation.metrics | dict.fromkeys(evaluation.reasons),
        reasons=evaluation.reasons,
        repetitions=evaluation.repetitions,
        curves=evaluation.curves,
        per_clip=evaluation.per_clip,
        clips=evaluation.clips,
        **about,
    )


def write_result(folder: Path, result: Result, frames: Mapping[str, np.ndarray]) -> None:
    """Writes the frames of :attr:`Evaluation.kept`, and then ``result.json``.

    Raises:
        FileError: the disk is full.
    """
    write_file(folder / FRAMES, encode(dict(frames)))
    write_json(folder / NAME, asdict(result), sealed=True)


def read_result(folder: Path) -> Result:
    """Reads a result.

    Raises:
        FileError: the file is missing, damaged or of another version.
    """
    path = folder / NAME
    cure = "rsjax evaluate makes it again"
    try:
        return Result(**read_json(path, cure=cure))
    except TypeError as error:
        raise FileError(f"{path}: of another version ({error}); {cure}") from error


def read_frames(folder: Path) -> dict[str, np.ndarray]:
    """Reads the kept frames of some of the scored clips; see :attr:`Evaluation.kept`.

    Raises:
        StoreError: the file is missing or damaged.
    """
    try:
        return decode(regular(folder / FRAMES).read_bytes())
    except (OSError, ValueError) as error:
        raise StoreError(f"{folder / FRAMES}: cannot be read ({error}); evaluate again with --overwrite") from error


def fingerprint(params: Any) -> str:
    """Returns a hash of parameters' names, types, shapes and values: 16 hex digits."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        array = np.asarray(leaf)
        digest.update(f"{jax.tree_util.keystr(path)} {array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]
