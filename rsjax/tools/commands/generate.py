"""Generates videos from a trained run. ``rsjax generate tiny --clips 0 3 --format gif``"""

import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import tyro

from rsjax.config import SampleConfig
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options


@dataclass(frozen=True)
class Options:
    """Generates the frames that follow a clip's prompt, and writes truth and prediction side by side."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A run directory, made by rsjax train; a saved model; or tiny or multitask, the package's models."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    store: Path | None = None
    """The new path of the run's store of ingested clips, if it was moved."""
    split: Literal["test", "train"] = "test"
    """The split that the clips are from."""
    clips: tuple[int, ...] = ()
    """Numbers of the clips within the split; default: the first four."""
    actions_from: int | None = None
    """Use this clip's actions instead of each clip's own."""
    actions: Path | None = None
    """Use the actions in this .npy file, float (T, A), in the data's units; row t leads into frame t."""
    frames: int | None = None
    """Frames per video, possibly more than in training; shorter actions are repeated."""
    out: Path | None = None
    """Directory of the videos; default RUN/generated, or runs/tiny/generated for the package's model."""
    format: Literal["mp4", "gif"] = "mp4"
    """File format."""
    fps: float = 4.0
    """Frames per second, 0.1 to 240."""
    scale: int = 4
    """Factor by which videos that show only the prediction are enlarged, 1 to 64."""
    steps: int | None = None
    """Decoding steps per frame. This and the following options default to the run's settings."""
    temperature: float | None = None
    """Logits are divided by the temperature; 0: take the most probable code."""
    unmask: Literal["random", "greedy"] | None = None
    """Unmask random cells first, or those with the highest confidence."""
    top_k: int | None = None
    """Draw from the k most probable codes of each vocabulary; 0: from all codes."""
    mean_codes: bool | None = None
    """Decode pictures from mean codes instead of the most probable ones; no effect at temperatures above 0."""
    read_means: bool | None = None
    """Let later frames read the mean codes too; no effect without --mean-codes."""
    guidance: float | None = None
    """Guidance strength; 1: none. Guidance by actions needs model.departures.action_dropout; by text,
    model.text.dropout or a file."""
    window_stride: int | None = None
    """Frames by which a full window moves on (with learned positions); 0: half of the window."""
    cache_dtype: Literal["float32", "bfloat16"] | None = None
    """Data type of the cache of keys and values."""
    seed: int | None = None
    """Seed of the random draws, 0 to 4294967295."""
    keep_still: Literal["on", "off"] | None = None
    """Keep what stands still from the first frame; for fixed cameras."""


@main_errors()
def main() -> None:
    """Writes one video per clip and prints its path."""
    tune_process()
    options = parse_options(sys.argv[1:], "rsjax generate", Options.__doc__ or "", Options())
    from rsjax.model_directory import locate, output_directory
    from rsjax.tools.pipeline.videos import VideoRequest, write_videos

    decoding = {field.name: getattr(options, field.name) for field in fields(SampleConfig)}
    sample = {name: value for name, value in decoding.items() if value is not None}
    request = VideoRequest(options.split, options.clips, options.actions_from, options.actions, options.frames, sample)
    run = locate(options.run)
    out = options.out or output_directory(run, "generated")
    how = (options.format, options.fps, options.scale, options.store)
    for path in write_videos(run, options.data_dir, request, out, *how):
        print(path)
