"""Generates videos with the model of a trained run, one per clip, and a demonstration of it."""

import dataclasses
import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from rsjax.clip import GENERATED_MARK
from rsjax.config import Config
from rsjax.config.config_fields import with_values
from rsjax.data.clips import Clips
from rsjax.data.store import Source
from rsjax.errors import UserError
from rsjax.files import placeholder, regular, write_file
from rsjax.models.base import create_model
from rsjax.models.load_run import load
from rsjax.models.trained import TrainedModel
from rsjax.tools.pipeline.limits import check_rollout
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.run_clips import relocated
from rsjax.tools.studies.report.figures import ClipFigure, animation, filmstrip
from rsjax.tools.studies.report.video import write_gif, write_mp4

FPS = (0.1, 240.0)  # a GIF cannot show a frame for more than eleven minutes
MOST_SCALE = 64
DEMO_FPS = 4.0


@dataclass(frozen=True)
class VideoRequest:
    """The clips, actions and settings to generate with.

    Attributes:
        split: a split of the run's data set.
        clips: numbers of the clips within the split; empty: the first four.
        actions_from: a clip of the same split whose actions are used for all clips; None: each clip's own.
        actions: a .npy file of actions that are used for all clips, (T, A) in the data's units.
        frames: frames per video, the prompt included; shorter actions are repeated. None: as many as the actions have.
        sample: changed fields of :class:`rsjax.config.SampleConfig`.
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
    request: VideoRequest,
    out: Path,
    kind: Literal["mp4", "gif"],
    fps: float,
    scale: int,
    store: Path | None = None,
) -> Iterator[Path]:
    """Generates and writes a video per clip: truth and prediction side by side, with depth if the model has it.

    With actions of another source, or beyond a clip's end, there is no truth, so the video shows only the prediction.

    Args:
        run, data: the directories of the run and of simulated data sets.
        out: the directory of the videos.
        scale: enlargement of videos that show only the prediction.
        store: the new path of the run's store of ingested clips, if it was moved.

    Yields:
        The path of each written file.

    Raises:
        UserError: the run, its data or a clip is missing, or the actions do not fit.
    """
    trained = load(run)
    config = trained.config
    if store:
        config = relocated(config, store)
    source = Run(config, run, data).open_clips().source(request.split)
    clips = chosen_clips(request, source)
    if not FPS[0] <= fps <= FPS[1] or not 1 <= scale <= MOST_SCALE:
        limits = f"{FPS[0]} to {FPS[1]} and 1 to {MOST_SCALE}"
        raise UserError(f"--fps is {fps} and --scale is {scale}; they can be {limits}")
    trained = resampled(trained, request.sample)
    foreign = _foreign_actions(request, source, config)
    for number in clips:
        clip = source[number]
        actions = clip["actions"]
        name = f"{request.split}_{number:03d}"
        if foreign is not None:
            actions = foreign
            name += "_other_actions"
        if request.frames is not None:
            name += f"_{request.frames}_frames"
            if request.frames <= config.prompt_frames:
                prompt_frames = config.prompt_frames
                raise UserError(f"--frames is {request.frames}, but the prompt has {prompt_frames}; set it higher")
            check_rollout(config, request.frames)
            turns = 1 + np.arange(request.frames - 1) % (len(actions) - 1)  # row 0 is not an action
            actions = actions[np.concatenate([[0], turns])]
        prompt = Clips.stacked([clip], [number]).video.frames(0, config.prompt_frames)
        inputs = (trained.params, trained.assets, prompt, actions[None])
        made = trained.model.generate(*inputs, index=np.array([number]))
        path = out / f"{name}.{kind}"
        write = write_mp4 if kind == "mp4" else write_gif
        if foreign is not None or len(actions) > len(clip["rgb"]):  # there is no true video to show beside it
            write(path, made.rgb[0], fps, scale, GENERATED_MARK)
        else:
            shown = len(made.rgb[0])
            depth = {}
            if made.depth is not None:
                depth = {"true_depth": clip["depth"][:shown], "predicted_depth": made.depth[0]}
            unit = clip["provenance"].get("depth_unit") or "metres"
            sides = {"truth": clip["rgb"][:shown], "prediction": made.rgb[0], **depth}
            figure = ClipFigure(f"clip {number}", **sides, prompt_frames=config.prompt_frames, depth_unit=unit)
            write(path, animation(figure), fps, 1, GENERATED_MARK)
        yield path


def write_demo(model: Path, data_dir: Path, out: Path, number: int | None = None) -> list[Path]:
    """Generates a held-out clip from its first frame, under its own actions and under the next clip's.

    Args:
        number: of the clip; None: the first that ends in success, if one does.

    Returns:
        The paths of a video and of a film strip. Their rows: the recording, the two predictions, and depth.

    Raises:
        UserError: the model or its clips are missing, or it has no clip of this number.
    """
    trained = load(model)
    source = Run(trained.config, model, data_dir).open_clips().source("test")
    if number is None:
        number = next((each for each in range(len(source)) if source[each]["success"][-1]), 0)
    if not 0 <= number < len(source):
        raise UserError(f"--clip {number}: the model has clips 0 … {len(source) - 1}")
    clip = source[number]
    seen = trained.config.prompt_frames
    prompt = Clips.stacked([clip], [number]).video.frames(0, seen)
    following = source[(number + 1) % len(source)]["actions"]
    other = np.concatenate([clip["actions"][:seen], following[seen:]])  # the prompt's frames have one past
    videos = trained.model.plan(trained.params, trained.assets, prompt, np.stack([clip["actions"], other]))
    depth = {}
    if videos.depth is not None:
        depth = {"true_depth": clip["depth"], "predicted_depth": videos.depth[0]}
    figure = ClipFigure(
        f"clip {number}: {clip['task']}",
        clip["rgb"],
        videos.rgb[0],
        other_actions=videos.rgb[1],
        **depth,
        prompt_frames=seen,
        depth_unit=clip["provenance"].get("depth_unit") or "metres",
    )
    video = out / f"clip-{number}.mp4"
    strip = video.with_suffix(".png")
    write_mp4(video, animation(figure), DEMO_FPS, comment=GENERATED_MARK)
    picture = io.BytesIO()
    mark = PngInfo()
    mark.add_text("Comment", GENERATED_MARK)
    Image.fromarray(filmstrip(figure)).save(picture, "PNG", pnginfo=mark)
    write_file(strip, picture.getvalue())
    return [video, strip]


def chosen_clips(request: VideoRequest, source: Source) -> tuple[int, ...]:
    """Returns the numbers of the clips to generate.

    Raises:
        UserError: the split lacks one of them, or the clip whose actions are wanted.
    """
    if not len(source):
        raise UserError(f"the {request.split} split has no clips; choose another with --split")
    clips = request.clips or tuple(range(min(4, len(source))))
    asked = [("--clips", number) for number in clips]
    if request.actions_from is not None:
        asked.append(("--actions-from", request.actions_from))
    for flag, number in asked:
        if not 0 <= number < len(source):
            last = len(source) - 1
            raise UserError(f"{flag}: no clip {number} in the {request.split} split, which has 0 … {last}")
    return clips


def _foreign_actions(request: VideoRequest, source: Source, config: Config) -> Float[np.ndarray, "T A"] | None:
    if request.actions_from is not None:
        return source[request.actions_from]["actions"]
    if request.actions is None:
        return None
    try:
        actions = np.load(regular(request.actions), allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        instead = placeholder(request.actions) or f"not a readable .npy file of numbers ({error})"
        raise UserError(f"{request.actions}: {instead}") from error
    if not isinstance(actions, np.ndarray):
        raise UserError(f"{request.actions}: an .npz archive of {len(actions.files)} arrays; save one of them as .npy")
    width = config.clips.action_dim
    shortest = config.prompt_frames + 1
    if actions.ndim != 2 or actions.shape[1] != width or len(actions) < shortest:
        fits = f"(T, {width}) with T at least {shortest}"
        raise UserError(f"{request.actions}: shape {actions.shape}; this model takes {fits}")
    if actions.dtype.kind not in "fiu" or not np.isfinite(actions).all():
        raise UserError(f"{request.actions}: {actions.dtype} with values that are not finite numbers; give floats")
    return actions


def resampled(trained: TrainedModel, sample: dict[str, Any]) -> TrainedModel:
    """Returns the model with changed fields of ``model.sample``.

    Raises:
        UserError: the model's family has no such settings, or a value is not allowed.
    """
    if not sample:
        return trained
    settings = getattr(trained.config.model, "sample", None)
    if settings is None:
        raise UserError(f"a model of family {trained.config.model.family!r} has no settings of sampling")
    known = [field.name for field in dataclasses.fields(settings)]
    if unknown := sample.keys() - known:
        names = f"{', '.join(sorted(unknown))}; it has {', '.join(known)}"
        raise UserError(f"a model of family {trained.config.model.family!r} has no setting {names}")
    cells = trained.config.grid**2
    if "unmask" in known and sample.get("steps", 1) > cells:
        raise UserError(
            f"steps is {sample['steps']}, but a frame has {cells} cells, of which each step decodes one at least; take "
            f"at most as many"
        )
    model = dataclasses.replace(trained.config.model, sample=with_values(settings, sample))  # type: ignore[call-arg]
    config = dataclasses.replace(trained.config, model=model)
    return dataclasses.replace(trained, config=config, model=create_model(config))
