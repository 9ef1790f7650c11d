"""The public interface of a trained world model: numpy arrays in, numpy arrays out."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from rsjax.clip import Video
from rsjax.config import Config, to_dict
from rsjax.errors import UserError
from rsjax.files import check_place, checked_path
from rsjax.model_directory import Dtype, Part, save_directory
from rsjax.models.base import Assets, WorldModel
from rsjax.models.card import model_card
from rsjax.tokenizers.codec import Codec, Tokens
from rsjax.trainable import Params


class ShapeError(UserError):
    """An array of the wrong shape or type. The message names the argument and the expected shape."""


@dataclass(frozen=True)
class TrainedModel:
    """A world model with its parameters, ready to generate. Made by :func:`rsjax.load`.

    Attributes:
        directory: the run or saved model that it was loaded from; None: it was made otherwise.
    """

    config: Config
    model: WorldModel[Any]
    params: Params
    assets: Assets
    directory: Path | None = None

    def __repr__(self) -> str:
        count = sum(x.size for x in jax.tree.leaves(self.params))
        clips = self.config.clips
        return (
            f"TrainedModel({self.config.name!r}, {self.config.model.family}, {count:,} parameters, clips of "
            f"{clips.frames} frames of {clips.image_size} pixels, {self.directory})"
        )

    def generate(
        self,
        frames: UInt8[np.ndarray, "*B P H W 3"],
        actions: Float[np.ndarray, "*B T A"],
        depth: Float[np.ndarray, "*B P H W"] | None = None,
        task: str | Sequence[str] | None = None,
    ) -> Video:
        """Generates the video that follows these frames under these actions.

        Args:
            frames: the first P frames of one clip or of B clips, 0–255, RGB; P = 1 in the paper.
            actions: in the recording's units; row t leads into frame t, and row 0 is ignored. T may exceed the length
                of the training clips.
            depth: z-depth of the frames in metres; None if unknown.
            task: the robot's task in words, one for all clips or one for each; only CogVideoX reads it. If that has no
                text of the task, it prints a note and uses the empty text.

        Returns:
            All T frames with their depth (None without a depth branch or ``depth``); without a leading axis for one
            clip. The first P frames are the prompt as the model sees it.

        Raises:
            ShapeError: an argument has the wrong shape or type for this model; the message says which.
        """
        prompt, single = self._prompt(frames, depth, task)
        sequences = self._actions(actions, prompt, () if single else (len(prompt),))
        clips = sequences.reshape(-1, *sequences.shape[-2:])
        video = self.model.generate(self.params, self.assets, prompt, clips)
        return _first(video) if single else video

    def plan(
        self,
        frames: UInt8[np.ndarray, "P H W 3"],
        actions: Float[np.ndarray, "N T A"],
        depth: Float[np.ndarray, "P H W"] | None = None,
        task: str | None = None,
    ) -> Video:
        """Generates the N videos that follow the frames of one clip under N action sequences.

        All candidates share their random draws, so they differ only by their actions. Arguments and errors are those of
        :meth:`generate`. In rows 1 to P - 1, which led into the frames, all candidates have the same actions.
        """
        prompt, single = self._prompt(frames, depth, task)
        if not single:
            raise ShapeError(f"frames have shape {np.shape(frames)}; a plan starts from one clip, (P, H, W, 3)")
        candidates = self._actions(actions, prompt, ("N",))
        past = prompt.rgb.shape[1]
        if np.any(candidates[:, 1:past] != candidates[:1, 1:past]):
            raise ShapeError(
                f"actions differ in rows before {past}, which led into the {past} frames; expected the same rows 1 to "
                f"{past - 1} in all candidates"
            )
        return self.model.plan(self.params, self.assets, prompt, candidates)

    def encode(
        self, frames: UInt8[np.ndarray, "*B T H W 3"], depth: Float[np.ndarray, "*B T H W"] | None = None
    ) -> dict[str, Int[np.ndarray, "*B T h w"]]:
        """Returns the tokens of frames as "rgb" and, if ``depth`` is passed, of depth maps as "depth".

        Raises:
            ShapeError: an array has the wrong shape or type for this model.
            UserError: the model has no tokens.
        """
        video, single = self._video(frames, depth)
        tokens = self._codec().encode(video)
        return {name: grid[0] if single else grid for name, grid in tokens.items()}

    def decode(self, tokens: dict[str, Int[np.ndarray, "*B T h w"]]) -> Video:
        """Decodes tokens to a video.

        Raises:
            ShapeError: the tokens have the wrong shape or type for this model.
            UserError: the model has no tokens.
        """
        codec = self._codec()
        grid = self.config.grid
        codes = 2**self.config.tokenizer.code_bits
        if not isinstance(tokens, Mapping) or not all(isinstance(name, str) for name in tokens):
            raise ShapeError(f"tokens are {type(tokens).__name__}; expected a dict with rgb, or rgb and depth")
        arrays = {name: as_array(f"tokens {name!r}", x) for name, x in tokens.items()}
        if not {"rgb"} <= arrays.keys() <= {"rgb", "depth"}:
            raise ShapeError(f"tokens are of {', '.join(arrays) or 'nothing'}; expected rgb, or rgb and depth")
        for name, x in arrays.items():
            if x.ndim not in (3, 4) or x.shape[-2:] != (grid, grid) or x.dtype.kind not in "iu":
                raise ShapeError(
                    f"tokens {name!r} have shape {x.shape} and type {x.dtype}; expected (T, {grid}, {grid}) for one "
                    f"clip or (B, T, {grid}, {grid}) for several, integers"
                )
            if not x.size or not 0 <= x.min() <= x.max() < codes:
                raise ShapeError(
                    f"tokens {name!r} are {_extent(x)}; expected one frame at least, from 0 to {codes - 1}"
                )
            if x.shape != arrays["rgb"].shape:
                raise ShapeError(f"tokens {name!r} have shape {x.shape}; expected {arrays['rgb'].shape}, that of 'rgb'")
        single = arrays["rgb"].ndim == 3
        batch: Tokens = {name: x.reshape(-1, *x.shape[-3:]) for name, x in arrays.items()}
        video = codec.decode(batch, np.full(len(batch["rgb"]), "depth" in batch))
        return _first(video) if single else video

    def save(self, directory: Path | str, dtype: Dtype = "float32", card: str = "") -> None:
        """Writes the model as a directory that :func:`rsjax.load` and a hub take as it is (``docs/models_on_disk.md``).

        An older saved model there is replaced, with all its files.

        Args:
            directory: gets ``config.json``, ``model.safetensors`` and ``README.md``.
            dtype: ``float16`` halves the file.
            card: the text of ``README.md``, by default a few lines on what the model takes and returns.

        Raises:
            UserError: the directory holds something else, or a parameter is too large for ``float16``.
            FileError: the disk is full or cannot be written to.
        """
        directory = checked_path(directory, "directory")
        check_place(directory, "directory", directory=True)
        if not isinstance(dtype, str) or dtype not in get_args(Dtype):
            raise UserError(f"dtype is {dtype!r:.80}; choose {' or '.join(get_args(Dtype))}")
        if not isinstance(card, str):
            raise UserError(f"card is {type(card).__name__}; it is the text of README.md")
        settings = to_dict(self.config)
        if self.config.data is not None:  # the name of the store is enough; its path is this machine's
            settings["data"]["store"] = Path(self.config.data.store).name
        parts: dict[Part, Params] = {"world_model": self.params}
        if self.config.model.uses_tokenizer and self.assets.tokenizer is not None:
            parts["tokenizer"] = self.assets.tokenizer
        saved = {"normalization": asdict(self.assets.normalization)}
        save_directory(directory, settings, saved, parts, dtype, card or model_card(self.config, directory.name))

    def _codec(self) -> Codec:
        if self.assets.tokenizer is None or self.config.model.own_autoencoder is not None:
            family = self.config.model.family
            raise UserError(f"a model of family {family!r} has no tokens that encode and decode take; use generate")
        return Codec(self.config.tokenizer, self.assets.tokenizer, self.assets.normalization)

    def _actions(self, actions: Any, prompt: Video, lead: tuple[int | str, ...]) -> Float32[np.ndarray, "*B T A"]:
        """Checks and returns actions as float32; ``lead`` are the sizes of axes before T, "N" for any above 0."""
        actions = as_array("actions", actions)
        width = self.config.clips.action_dim
        past = prompt.rgb.shape[1]
        expected = ", ".join(map(str, (*lead, "T", width)))
        fits = actions.ndim == len(lead) + 2 and actions.shape[-1] == width and actions.shape[-2] > past
        if not fits or (lead and (not len(actions) if lead == ("N",) else len(actions) != lead[0])):
            raise ShapeError(f"actions have shape {actions.shape}; expected ({expected}) with T above {past}")
        if actions.dtype.kind not in "fiu" or not np.isfinite(_float32(actions)).all():
            raise ShapeError(f"actions are {actions.dtype} with values that are not finite numbers; expected floats")
        return _float32(actions)

    def _prompt(self, frames: Any, depth: Any, task: str | Sequence[str] | None) -> tuple[Video, bool]:
        """Returns :meth:`_video` with the clips' tasks."""
        prompt, single = self._video(frames, depth)
        if task is None:
            return prompt, single
        if isinstance(task, str):
            task = [task] * len(prompt)
        if not isinstance(task, Sequence) or not all(isinstance(each, str) for each in task):
            raise ShapeError(f"task is {task!r:.80}; expected one text, or {len(prompt)}, one for each clip")
        if len(task) != len(prompt):
            raise ShapeError(f"task has {len(task)} texts; expected one, or {len(prompt)}, one for each clip")
        return replace(prompt, tasks=np.array(task)), single

    def _video(self, frames: Any, depth: Any) -> tuple[Video, bool]:
        """Checks and returns the arguments with a leading axis over clips, and whether that axis was added."""
        frames = as_array("frames", frames)
        size = self.config.clips.image_size
        if (
            not frames.size
            or frames.ndim not in (4, 5)
            or frames.shape[-3:] != (size, size, 3)
            or frames.dtype != np.uint8
        ):
            raise ShapeError(
                f"frames have shape {frames.shape} and type {frames.dtype}; expected (P, {size}, {size}, 3) for one "
                f"clip or (B, P, {size}, {size}, 3) for several, uint8, with P and B above 0"
            )
        single = frames.ndim == 4
        clips = frames.reshape(-1, *frames.shape[-4:])
        if depth is None:
            return Video(clips), single
        depth = as_array("depth", depth)
        if depth.shape != frames.shape[:-1] or depth.dtype.kind not in "fiu":
            raise ShapeError(
                f"depth has shape {depth.shape} and type {depth.dtype}; expected {frames.shape[:-1]}, that of the "
                f"frames, floats"
            )
        if not is_depth(depth):
            raise ShapeError(f"depth is {_extent(depth)}; expected metres, 0 or more, or NaN where it is unknown")
        return Video(clips, _float32(depth).reshape(clips.shape[:-1])), single


def is_depth(depth: Float[np.ndarray, "*B H W"]) -> bool:
    """Returns whether numbers can be z-depth in metres: finite and not negative; NaN is unknown."""
    return not (depth < 0).any() and not np.isinf(_float32(depth)).any()


def _float32(x: np.ndarray) -> Float32[np.ndarray, "*N"]:
    """Returns numbers as float32; those beyond its range become infinite."""
    with np.errstate(over="ignore"):
        return x.astype(np.float32)


def as_array(name: str, value: Any) -> np.ndarray:
    """Returns an argument as an array.

    Raises:
        ShapeError: it is not an array, or one with masked numbers.
    """
    if isinstance(value, np.ma.MaskedArray) and value.mask.any():
        raise ShapeError(f"{name} are masked, and a model cannot leave numbers out; fill them or pass other ones")
    try:
        return np.asarray(value)
    except (ValueError, TypeError) as error:  # lists of other lengths, or what has no length
        raise ShapeError(f"{name} cannot be made an array ({error}); expected numbers of one shape") from error


def _extent(x: np.ndarray) -> str:
    if not x.size:
        return f"empty, of shape {x.shape}"
    return f"from {x.min()} to {x.max()}"


def _first(video: Video) -> Video:
    depth, state = (None if x is None else x[0] for x in (video.depth, video.state))
    return Video(video.rgb[0], depth, state=state)
