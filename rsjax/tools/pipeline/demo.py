"""Shows what a model does, without a display: a video and a picture of one of the clips beside it."""

import io
from pathlib import Path

import numpy as np
from PIL import Image

from rsjax.data.clips import Clips
from rsjax.errors import UserError
from rsjax.files import write_file
from rsjax.models.load_run import load
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.report.figures import ClipFigure, animation, filmstrip
from rsjax.tools.studies.report.video import write_mp4

FPS = 4.0


def write_demo(model: Path, data_dir: Path, out: Path, number: int) -> list[Path]:
    """Generates a held-out clip from its first frame, under its own actions and under the next clip's.

    Returns:
        The paths of a video and of a film strip. Their rows: the recording, the two predictions, and depth.

    Raises:
        UserError: the model or its clips are missing, or it has no clip of this number.
    """
    trained = load(model)
    source = Run(trained.config, model, data_dir).open_clips().source("test")
    if not 0 <= number < len(source):
        raise UserError(f"--clip {number}: the model has clips 0 … {len(source) - 1}")
    clip = source[number]
    prompt = Clips.stacked([clip], [number]).video.frames(0, trained.config.prompt_frames)
    other = source[(number + 1) % len(source)]["actions"]
    videos = trained.model.plan(trained.params, trained.assets, prompt, np.stack([clip["actions"], other]))
    depth = {}
    if videos.depth is not None:
        depth = {"true_depth": clip["depth"], "predicted_depth": videos.depth[0]}
    title = f"clip {number}: {clip['task']}"
    figure = ClipFigure(title, clip["rgb"], videos.rgb[0], other_actions=videos.rgb[1], **depth)
    video = out / f"clip-{number}.mp4"
    strip = video.with_suffix(".png")
    write_mp4(video, animation(figure), FPS)
    picture = io.BytesIO()
    Image.fromarray(filmstrip(figure)).save(picture, "PNG")
    write_file(strip, picture.getvalue())
    return [video, strip]
