"""Videos from a trained run, one per clip."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from rsjax.config import Config, SampleConfig
from rsjax.data.store import Record, Source
from rsjax.errors import UserError
from rsjax.pipeline.clips import Clips
from rsjax.pipeline.generator import Generated, Generator
from rsjax.pipeline.own_data import relocated
from rsjax.pipeline.run import Run
from rsjax.report.figures import ClipFigure, animation
from rsjax.report.video import write_gif, write_mp4


@dataclass(frozen=True)
class Request:
    """What to generate.

    Attributes:
        split: of the run's data set.
        clips: numbers within the split, whose first frames are given; none: the first four.
        actions_from: a clip of the same split whose actions drive them all; None: each clip's own.
        actions: a .npy file of actions that drive them all, (T, A) in the data's units.
        frames: how many to show, the given ones among them; actions that end before begin again. None: as many as there
            are actions.
        sample: fields of :class:`rsjax.config.SampleConfig` in which decoding differs from the run's own.
    """

    split: str
    clips: tuple[int, ...]
    actions_from: int | None
    actions: Path | None
    frames: int | None
    sample: dict[str, Any]


def write_videos(
    run: Path,
    data: Path,
    request: Request,
    out: Path,
    kind: Literal["mp4", "gif"],
    fps: float,
    scale: int,
    store: Path | None = None,
) -> Iterator[Path]:
    """Generates and writes a video per clip: truth and prediction side by side, with depth where the model has it.

    Under foreign actions, or beyond a clip's end, there is no truth to show, only what was generated.

    Args:
        run, data: the run's directory, and where simulated data sets are kept.
        out: where the files go.
        scale: pixels per pixel, where prediction alone is shown.
        store: where the run's store of clips lies now, if it was ingested and has moved since.

    Yields:
        Each file's path, once it is written.

    Raises:
        UserError: the run or its data are missing, a clip does not exist, or the actions do not fit.
    """
    generator = Generator.load(run)
    sample = dataclasses.replace(generator.config.sample, **request.sample)
    config = relocated(generator.config, store) if store else generator.config
    source = Run(config, run, data).open_clips().source(request.split)
    clips = request.clips or tuple(range(min(4, len(source))))
    for flag, numbers in (("--clips", clips), ("--actions-from", (request.actions_from or 0,))):
        for number in numbers:
            if not 0 <= number < len(source):
                last = len(source) - 1
                raise UserError(f"{flag}: no clip {number} in the {request.split} split, which has 0 … {last}")
    if not fps > 0 or scale < 1:
        raise UserError(f"--fps is {fps} and --scale is {scale}; both must be positive")
    sample.check(generator.config.model)
    foreign = _foreign_actions(request, source, generator.config)
    for number in clips:
        clip = source[number]
        actions = _lasting(clip["actions"] if foreign is None else foreign, request, generator.config)
        made = _generate(generator, clip, actions, sample, number)
        alone = foreign is not None or len(actions) > len(clip["rgb"])
        name = f"{request.split}_{number:03d}{'' if foreign is None else '_other_actions'}"
        path = out / f"{name}{'' if request.frames is None else f'_{request.frames}_frames'}.{kind}"
        frames = made.rgb[0] if alone else _side_by_side(clip, made, number)
        (write_mp4 if kind == "mp4" else write_gif)(path, frames, fps, scale if alone else 1)
        yield path


def _foreign_actions(request: Request, source: Source, config: Config) -> Float[np.ndarray, "T A"] | None:
    if request.actions_from is not None:
        return source[request.actions_from]["actions"]
    if request.actions is None:
        return None
    try:
        actions = np.load(request.actions, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise UserError(f"{request.actions}: not a readable .npy file of numbers ({error})") from error
    width, shortest = config.clips.action_dim, config.mask.prompt_frames + 1
    if actions.ndim != 2 or actions.shape[1] != width or len(actions) < shortest:
        fits = f"(T, {width}) with T at least {shortest}"
        raise UserError(f"{request.actions}: shape {actions.shape}; this model takes {fits}")
    if actions.dtype.kind not in "fiu" or not np.isfinite(actions).all():
        raise UserError(f"{request.actions}: {actions.dtype} with values that are not finite numbers; give floats")
    return actions


def _lasting(actions: Float[np.ndarray, "T A"], request: Request, config: Config) -> Float[np.ndarray, "F A"]:
    """Actions for the frames asked for: cut, or begun again after the last. Row 0 led nowhere and is not repeated."""
    if request.frames is None:
        return actions
    if request.frames <= config.mask.prompt_frames:
        raise UserError(f"--frames is {request.frames}, of which {config.mask.prompt_frames} are given; ask for more")
    turns = 1 + np.arange(request.frames - 1) % (len(actions) - 1)
    return actions[np.concatenate([[0], turns])]


def _generate(generator: Generator, clip: Record, actions: np.ndarray, sample: SampleConfig, number: int) -> Generated:
    prompt = Clips.stacked([clip], [number]).tokens(generator.codec, generator.config.mask.prompt_frames)
    return generator.generate(prompt, actions[None], sample, index=np.array([number]))


def _side_by_side(clip: Record, made: Generated, number: int) -> UInt8[np.ndarray, "T H W 3"]:
    shown = len(made.rgb[0])
    depth = {} if made.depth is None else {"true_depth": clip["depth"][:shown], "predicted_depth": made.depth[0]}
    return animation(ClipFigure(title=f"clip {number}", truth=clip["rgb"][:shown], prediction=made.rgb[0], **depth))
