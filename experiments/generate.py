"""Videos from a trained run. ``python -m experiments.generate runs/tiny --clips 0 3 --format gif``"""

import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import tyro

from experiments.cli import main_errors, parse_options
from rsjax.config import SampleConfig
from rsjax.runtime import tune_process


@dataclass(frozen=True)
class Options:
    """Generates the frames that follow a clip's first one, and writes truth and prediction side by side."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A run directory, made by experiments.train."""
    data_dir: Path = Path("data")
    """Where the run's data set is kept, if it was simulated."""
    store: Path | None = None
    """Where the run's store of clips lies now, if it was ingested and has moved since."""
    split: Literal["test", "train"] = "test"
    """Which clips the first frames come from."""
    clips: tuple[int, ...] = ()
    """Their numbers within the split; the first four if none is named."""
    actions_from: int | None = None
    """Generate under this clip's actions instead of each clip's own."""
    actions: Path | None = None
    """Generate under the actions in this .npy file, float (T, A), in the data's units; row t leads into frame t."""
    frames: int | None = None
    """How many frames to show, also more than the model was trained on; actions that end before begin again."""
    out: Path | None = None
    """Where to write; RUN/generated if not given."""
    format: Literal["mp4", "gif"] = "mp4"
    """What to write."""
    fps: float = 4.0
    """Frames a second."""
    scale: int = 4
    """Pixels per pixel, where prediction alone is shown."""
    steps: int | None = None
    """Decoding steps a frame; the run's own if not given, as with all that follow."""
    temperature: float | None = None
    """Logits are divided by it; 0 takes the most probable code."""
    unmask: Literal["random", "greedy"] | None = None
    """Which cells are decided first: at random, or those most sure."""
    top_k: int | None = None
    """Draw among each vocabulary's this many most probable codes; 0: among all."""
    guidance: float | None = None
    """How strongly actions guide; 1: as trained, others need a model trained with model.action_dropout."""
    window_stride: int | None = None
    """Frames that leave a full window at once (learned positions); 0: half of it."""
    cache_dtype: Literal["float32", "bfloat16"] | None = None
    """Of what is remembered from frame to frame."""
    seed: int | None = None
    """Of the draws."""


@main_errors()
def main() -> None:
    """Writes one video per clip and prints its path."""
    tune_process()
    options = parse_options(sys.argv[1:], "python -m experiments.generate", Options.__doc__ or "", Options())
    from rsjax.pipeline.videos import Request, write_videos

    decoding = {field.name: getattr(options, field.name) for field in fields(SampleConfig)}
    sample = {name: value for name, value in decoding.items() if value is not None}
    request = Request(options.split, options.clips, options.actions_from, options.actions, options.frames, sample)
    out = options.out or options.run / "generated"
    how = (options.format, options.fps, options.scale, options.store)
    for path in write_videos(options.run, options.data_dir, request, out, *how):
        print(path)


if __name__ == "__main__":
    main()
