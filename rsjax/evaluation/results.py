"""The file of an evaluation: scores, and everything that they depend on, so that nothing unlike is ever compared."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.config import EvalConfig, to_dict
from rsjax.data.codec import decode, encode
from rsjax.data.store import StoreError
from rsjax.evaluation import depth_estimator
from rsjax.evaluation.evaluate import Evaluation
from rsjax.evaluation.frame_curves import Curves
from rsjax.files import FileError, content_hash, read_json, write_file, write_json

NAME, FRAMES = "result.json", "frames.msgpack"


@dataclass(frozen=True)
class Result:
    """An evaluation as it is written. All fields are JSON-ready.

    Attributes:
        label: the protocol's name with its changed fields.
        key: changes with whatever decides the scores, the code excepted.
        protocol: every field of the protocol.
        sampling: all settings of sampling, of which the protocol may fix some; empty for a family without any.
        settings: of the metrics; their files, and those of the depth estimator, by a hash of their content.
            ``physics_iq_threshold``: grey levels of 255 above which a pixel moves; results of earlier versions lack it.
        data: ``path``, ``key``, ``manifest_sha256``, ``split``, ``frames``, ``image_size`` and ``fps`` of the scored
            clips; ``fps``, frames per second, is None where nothing says it and absent in results of earlier versions.
        model: ``run``, ``preset``, ``family``, ``settings``, ``seed``, ``parameters``, ``weights_sha256``, the key of
            the data that it learned from as ``trained_on``, and how it was trained as ``training``: the settings of the
            training loops, but for seeds and starting points, and the tokenizer's. Earlier versions lack ``training``.
        code: version and git revision of rsjax.
        made: when (ISO 8601, UTC), and on which ``machine``.
        metrics: scores by name; None for a metric without, of which ``reasons`` says why.
        repetitions: the scores of each repetition.
        curves: as in curves.json.
        per_clip: the clips' scores by name, in the order of ``clips``, without clips that have no score: shorter where
            only some clips have depth or motion. Earlier versions scored tokens on 20 of the clips, spread evenly.
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
    """Returns the file's content; ``about`` are the fields that the evaluation does not know."""
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
    """Writes ``result.json``, and before it the frames that :attr:`Evaluation.kept` keeps.

    Raises:
        FileError: the disk is full.
    """
    write_file(folder / FRAMES, encode(dict(frames)))
    write_json(folder / NAME, asdict(result))


def read_result(folder: Path) -> Result:
    """Reads a result.

    Raises:
        FileError: it is missing, damaged or of another version.
    """
    path, cure = folder / NAME, "python -m experiments.evaluate makes it again"
    try:
        return Result(**read_json(path, cure=cure))
    except TypeError as error:
        raise FileError(f"{path}: of another version ({error}); {cure}") from error


def read_frames(folder: Path) -> dict[str, np.ndarray]:
    """Reads the frames that were kept of some of the scored clips; see :attr:`Evaluation.kept`.

    Raises:
        StoreError: they are missing or damaged.
    """
    try:
        return decode((folder / FRAMES).read_bytes())
    except (OSError, ValueError) as error:
        raise StoreError(f"{folder / FRAMES}: cannot be read ({error}); evaluate again with --overwrite") from error


def by_content(settings: EvalConfig) -> EvalConfig:
    """Returns the settings with a hash of each file's content in place of its path.

    Raises:
        UserError: a file cannot be read.
    """
    files = {name: value for name, value in to_dict(settings).items() if name.endswith("_weights") and value}
    hashes: dict[str, Any] = {name: content_hash(Path(value)) for name, value in files.items()}
    return replace(settings, **hashes, depth_estimator=depth_estimator.by_content(settings))


def fingerprint(params: Any) -> str:
    """Returns a hash of parameters' names, types, shapes and values: 16 hex digits."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        array = np.asarray(leaf)
        digest.update(f"{jax.tree_util.keystr(path)} {array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]
