"""A small network that judges a task from the last four frames; it learns from frames that the simulator labelled.

"Uninterpretable" is its third class, trained on frames that are corrupted on purpose: shuffled blocks, two clips on
top of one another, heavy noise, heavy blur. The validation also judges corrupted held-out frames.

Axes: B videos, F frames of a history, H×W pixels.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn
from flax.traverse_util import flatten_dict, unflatten_dict
from jaxtyping import Array, Bool, Float, Int, UInt8

from rsjax.config import content_key
from rsjax.data.codec import decode, encode
from rsjax.errors import UserError
from rsjax.evaluation.results import fingerprint
from rsjax.files import checked_path, read_json, regular, write_file
from rsjax.layers.group_norm import GroupNorm
from rsjax.progress import Progress
from rsjax.tools.policies.judges.judge import (
    FAIL,
    HISTORY,
    LABELS,
    SUCCESS,
    UNINTERPRETABLE,
    all_successes,
    frames_of,
    last_frames,
)

FILE = "judge.msgpack"
VALIDATION = "validation.json"
VALIDATED = ("raw", "reconstructed", "generated")  # kinds of videos in a validation
MOST_SIDE = 4096
SIDE = 64  # pixels; frames with a longer side are downsampled for the network
BATCH = 64  # histories in a training step, of which a quarter are corrupted
CORRUPTED = BATCH // 4
CHUNK = 256  # histories in a forward pass, at most


class JudgeNetwork(nn.Module):
    """Convolutions over a history's frames stacked as channels, then two linear layers."""

    @nn.compact
    def __call__(self, frames: UInt8[Array, "B F H W 3"]) -> Float[Array, "B 3"]:
        """Returns the logit of each label."""
        b, count, height, width, _ = frames.shape
        x = jnp.moveaxis(frames, 1, 3).reshape(b, height, width, count * 3).astype(jnp.float32) / 127.5 - 1
        if height > SIDE:
            x = jax.image.resize(x, (b, SIDE, SIDE, count * 3), "linear")
        for width, stride in ((24, 2), (32, 2), (32, 1), (48, 2), (48, 2)):
            x = nn.relu(GroupNorm(8)(nn.Conv(width, (3, 3), (stride, stride))(x)))
        return nn.Dense(len(LABELS))(nn.relu(nn.Dense(64)(x.reshape(b, -1))))


@dataclass(frozen=True)
class TrainedJudge:
    """A trained network and the temperature that calibrates it; a :class:`rsjax.tools.policies.judges.judge.Judge`.

    Attributes:
        side: of the frames that it was trained on, pixels.
        validation: the content of its ``validation.json``, if it was validated.
        in_a_row: how many frames in a row must show success.
    """

    params: Any
    temperature: float
    side: int
    validation: dict[str, Any] | None = None
    in_a_row: int = 1

    @cached_property
    def key(self) -> str:
        """A hash of the weights, the temperature and, above 1, the number of frames in a row."""
        rows = [self.in_a_row] if self.in_a_row > 1 else []
        return content_key("judge", fingerprint((self.params,)), self.temperature, *rows)

    def __call__(self, frames: UInt8[np.ndarray, "B T H W 3"]) -> Float[np.ndarray, "B 3"]:
        whole = last_frames(frames, frames_of(self))
        verdicts = []
        for place in range(self.in_a_row):
            history = whole[:, place : place + HISTORY]
            parts = []
            for start in range(0, len(history), CHUNK):
                parts.append(np.asarray(_probabilities(self.params, self.temperature, history[start : start + CHUNK])))
            verdicts.append(np.concatenate(parts))
        return all_successes(np.stack(verdicts))

    def save(self, folder: Path) -> None:
        """Writes what :func:`load_judge` reads, atomically."""
        arrays = {"/".join(path): np.asarray(x) for path, x in flatten_dict(self.params).items()}
        numbers = {"temperature": self.temperature, "side": self.side, "in_a_row": self.in_a_row}
        write_file(folder / FILE, encode(arrays | numbers))


def load_judge(folder: Path, side: int | None = None) -> TrainedJudge:
    """Reads a judge that ``rsjax judge`` trained, with its validation if that is of the same judge.

    Args:
        side: of the frames that the judge will see, pixels; None: not known yet.

    Raises:
        UserError: there is no judge, its file is damaged, or it does not take frames of that size.
    """
    folder = checked_path(folder, "judge")
    path = folder / FILE
    report = folder / VALIDATION
    try:
        record = decode(regular(path).read_bytes())
        temperature = float(record.pop("temperature"))
        trained_on = int(record.pop("side"))
        in_a_row = int(record.pop("in_a_row", 1))
        if not 0 < temperature < math.inf:
            raise ValueError(f"its temperature is {temperature}, not a number above 0")
        for name, number in (("side", trained_on), ("in_a_row", in_a_row)):
            if not 0 < number <= MOST_SIDE:
                raise ValueError(f"its {name} is {number}, not from 1 to {MOST_SIDE}")
        frames = jax.ShapeDtypeStruct((1, HISTORY, trained_on, trained_on, 3), np.uint8)
        shapes = jax.eval_shape(JudgeNetwork().init, jax.random.key(0), frames)["params"]
        wanted = {"/".join(names): x.shape for names, x in flatten_dict(shapes).items()}
        present = {name: np.shape(x) for name, x in record.items()}
        differing = sorted(name for name in present.keys() | wanted.keys() if present.get(name) != wanted.get(name))
        if differing:
            first = differing[0]
            raise ValueError(f"{first} is {present.get(first, 'missing')}, not {wanted.get(first, 'there')}")
        for name, x in record.items():
            if not isinstance(x, np.ndarray) or x.dtype.kind != "f" or not np.isfinite(x).all():
                raise ValueError(f"{name} is not an array of finite floats")
    except FileNotFoundError as error:
        raise UserError(f"{path}: no judge there; train one with rsjax judge RUN") from error
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise UserError(f"{path}: damaged ({error}); train it again with rsjax judge RUN") from error
    if side not in (None, trained_on):
        raise UserError(
            f"{path}: was trained on frames of {trained_on} × {trained_on} pixels, these have {side} × {side}; train "
            f"one on such frames with rsjax judge RUN"
        )
    params = unflatten_dict({tuple(name.split("/")): x for name, x in record.items()})
    judge = TrainedJudge(params, temperature, trained_on, in_a_row=in_a_row)
    validation = None
    if report.exists():
        validation = read_json(report, cure="train the judge again")
        _check_validation(report, validation)
    # An interrupted training may have left the validation of an earlier judge. Older validations do not name the judge.
    if validation and validation.get("judge", judge.key) == judge.key:
        return replace(judge, validation=validation)
    return judge


def _check_validation(path: Path, validation: dict[str, Any]) -> None:
    """Raises :class:`UserError` unless the parts of a validation have what results show of them."""
    count = len(LABELS)
    for kind in VALIDATED:
        if kind not in validation:
            continue
        part = validation[kind]
        try:
            confusion = np.asarray(part["confusion"], float)
            shares = [rate[0] for rates in part["whole_clips"].values() for rate in rates.values()]
            numbers = np.asarray([part["right"][0], part["calibration_error"], *shares], float)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise UserError(f"{path}: its part {kind!r} is damaged ({error}); train the judge again") from error
        if confusion.shape != (count, count) or not np.isfinite(confusion).all() or not np.isfinite(numbers).all():
            raise UserError(f"{path}: its part {kind!r} has no {count} × {count} counts; train the judge again")


@dataclass(frozen=True)
class Footage:
    """Labelled videos to learn from or to be validated on.

    Attributes:
        rgb: the N videos.
        success: the simulator's success predicate at each frame.
    """

    rgb: UInt8[np.ndarray, "N T H W 3"]
    success: Bool[np.ndarray, "N T"]

    def histories(
        self, videos: Int[np.ndarray, " B"], frames: Int[np.ndarray, " B"], count: int = HISTORY
    ) -> UInt8[np.ndarray, "B F H W 3"]:
        """Returns the ``count`` frames that end at the given frame, for each given video."""
        back = np.maximum(frames[:, None] - np.arange(count)[::-1], 0)
        return self.rgb[videos[:, None], back]


def train_judge(footage: Footage, validation: Footage, steps: int, seed: int = 0) -> TrainedJudge:
    """Trains a judge; the result depends on the arguments alone.

    Args:
        footage: training videos, which must show both success and failure.
        validation: held-out videos, on which the temperature is fitted.
        steps: steps of Adam, with batches of ``BATCH``.

    Raises:
        UserError: the videos show only success, or only failure.
    """
    of_label = [np.argwhere(footage.success == done) for done in (True, False)]
    if not all(map(len, of_label)):
        raise UserError(
            f"the simulator calls {footage.success.mean():.0%} of {footage.success.size} training frames a success; a "
            f"judge needs clips of both success and failure"
        )
    rng = np.random.default_rng(seed)
    height = footage.rgb.shape[2]
    videos = np.zeros((1, HISTORY, height, height, 3), np.uint8)
    params = jax.jit(JudgeNetwork().init)(jax.random.key(seed), videos)["params"]
    optimizer = optax.adam(optax.cosine_decay_schedule(2e-3, steps))
    state = optimizer.init(params)

    def loss(params: Any, frames: Array, labels: Array) -> Array:
        return optax.softmax_cross_entropy_with_integer_labels(_logits(params, frames), labels).mean()

    @jax.jit
    def step(params: Any, state: Any, frames: Array, labels: Array) -> tuple[Any, Any]:
        updates, state = optimizer.update(jax.grad(loss)(params, frames, labels), state)
        return optax.apply_updates(params, updates), state

    with Progress("judge", steps, "steps") as progress:
        for number in range(steps):
            params, state = step(params, state, *_batch(footage, of_label, rng))
            progress.update(number + 1)
    return TrainedJudge(params, _temperature(params, validation, rng), height)


def corrupted(
    frames: UInt8[np.ndarray, "B F H W 3"], others: UInt8[np.ndarray, "B F H W 3"], rng: np.random.Generator
) -> UInt8[np.ndarray, "B F H W 3"]:
    """Returns histories that nobody can interpret, each corrupted in one of four ways.

    If the side is not a multiple of 8, shuffled blocks and blur leave a border unchanged.

    Args:
        others: histories of other videos, which may be put on top.
    """
    edge = frames.shape[2] // 8
    size = 8 * edge
    lead = frames.shape[:2]
    inner = frames[:, :, :size, :size]
    shuffled = frames.copy()
    blurred = frames.astype(float)
    blocks = inner.reshape(*lead, 8, edge, 8, edge, 3).swapaxes(3, 4)
    mixed_up = blocks.reshape(*lead, 64, edge, edge, 3)[:, :, rng.permutation(64)]
    shuffled[:, :, :size, :size] = mixed_up.reshape(blocks.shape).swapaxes(3, 4).reshape(inner.shape)
    means = inner.reshape(*lead, 4, size // 4, 4, size // 4, 3).mean((3, 5), keepdims=True)
    blurred[:, :, :size, :size] = means.repeat(size // 4, 3).repeat(size // 4, 5).reshape(inner.shape)
    mixed = (frames.astype(np.float32) + others) / 2
    noisy = frames + rng.normal(0, rng.uniform(50, 110), frames.shape)
    kind = rng.integers(4, size=(len(frames), 1, 1, 1, 1))
    out = np.select([kind == 0, kind == 1, kind == 2], [shuffled, mixed, noisy], blurred)
    return np.clip(np.round(out), 0, 255).astype(np.uint8)


def _batch(footage: Footage, of_label: list[np.ndarray], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draws histories and their labels: half of them successes, then a quarter of all corrupted.

    Contrast, brightness, position (by up to 2 pixels) and noise change a little, as generated frames vary.
    """
    half = BATCH // 2
    chosen = np.concatenate([each[rng.integers(len(each), size=half)] for each in of_label])
    drawn = footage.histories(*chosen.T)
    one = (len(drawn), 1, 1, 1, 1)
    shifted = np.roll(drawn, rng.integers(-2, 3, 2), axis=(2, 3)).astype(np.float32)
    varied = (shifted - 128) * rng.uniform(0.85, 1.15, one) + 128 + rng.normal(0, 8, one)
    varied += rng.uniform(0, 10, one) * rng.standard_normal(drawn.shape, np.float32)
    frames = np.clip(np.round(varied), 0, 255).astype(np.uint8)
    labels = np.repeat([SUCCESS, FAIL], half)
    rows = rng.permutation(BATCH)[:CORRUPTED]
    others = (rows + rng.integers(1, BATCH, CORRUPTED)) % BATCH  # never the same history
    frames[rows] = corrupted(frames[rows], frames[others], rng)
    labels[rows] = UNINTERPRETABLE
    return frames, labels


def _temperature(params: Any, validation: Footage, rng: np.random.Generator) -> float:
    """Returns the temperature under which the held-out labels are most probable."""
    of_label = [each for each in (np.argwhere(validation.success == done) for done in (True, False)) if len(each)]
    if len(of_label) < 2:
        return 1.0
    batches = [_batch(validation, of_label, rng) for _ in range(8)]
    frames, labels = (np.concatenate(part) for part in zip(*batches, strict=True))
    logits = np.asarray(_logits(params, frames))
    grid = np.geomspace(0.25, 8, 61)
    log_p = jax.nn.log_softmax(logits[None] / grid[:, None, None], axis=-1)
    return float(grid[np.asarray(log_p)[:, np.arange(len(labels)), labels].mean(1).argmax()])


@jax.jit
def _logits(params: Any, frames: Array) -> Array:
    return cast(Array, JudgeNetwork().apply({"params": params}, frames))


@jax.jit
def _probabilities(params: Any, temperature: float, frames: Array) -> Array:
    return jax.nn.softmax(_logits(params, frames) / temperature, axis=-1)
