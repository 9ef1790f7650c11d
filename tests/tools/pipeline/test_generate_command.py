"""Videos from a run through the command."""

from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image, ImageSequence

from rsjax.config import presets
from rsjax.data.store import Source
from rsjax.errors import UserError
from rsjax.tools.pipeline.videos import VideoRequest, chosen_clips
from rsjax.training.checkpoint import save_weights
from tests.tools.pipeline import toy
from tests.tools.pipeline.conftest import Commands

PROGRAM = "experiments.generate"
FRAMES = presets.debug().sim.frames


def read(path: Path) -> np.ndarray:
    """A video's frames, uint8 (T, H, W, 3)."""
    if path.suffix == ".gif":
        with Image.open(path) as image:
            return np.stack([np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)])
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def generate(command: Commands, run: Path, out: Path, *arguments: object) -> dict[str, np.ndarray]:
    """What the command wrote, by file name, checked against what it printed."""
    paths = [Path(line) for line in command.here(PROGRAM, run, "--out", out, *arguments).splitlines()]
    assert sorted(paths) == sorted(out.iterdir())
    return {path.name: read(path) for path in paths}


def test_truth_and_prediction_side_by_side(debug: Path, command: Commands, tmp_path: Path) -> None:
    videos = generate(command, debug, tmp_path / "out", "--clips", 0, 1, "--format", "gif")
    assert list(videos) == ["test_000.gif", "test_001.gif"]
    for frames in videos.values():
        assert len(frames) == FRAMES
        assert frames.shape[2] > 2 * 64, "two pictures wide at least"
    first, second = videos.values()
    assert not np.array_equal(first, second)


def test_under_other_actions_the_prediction_alone(debug: Path, command: Commands, tmp_path: Path) -> None:
    """As many frames as there are rows of actions, enlarged by the scale."""
    actions = np.random.default_rng(0).normal(size=(3, 28)).astype(np.float32)
    np.save(tmp_path / "actions.npy", actions)
    short = generate(command, debug, tmp_path / "file", "--clips", 0, "--actions", tmp_path / "actions.npy")
    assert short["test_000_other_actions.mp4"].shape == (3, 256, 256, 3)
    taken = generate(
        command, debug, tmp_path / "clip", "--split", "train", "--clips", 2, "--actions-from", 1, "--scale", 2
    )
    assert taken["train_002_other_actions.mp4"].shape == (FRAMES, 128, 128, 3)


def test_more_frames_than_the_model_was_trained_on(debug: Path, command: Commands, tmp_path: Path) -> None:
    """Of more frames than the clip has, the prediction alone; of fewer, both."""
    long = generate(command, debug, tmp_path / "long", "--clips", 0, "--frames", 2 * FRAMES + 1, "--top-k", 3)
    assert long[f"test_000_{2 * FRAMES + 1}_frames.mp4"].shape == (2 * FRAMES + 1, 256, 256, 3)
    short = generate(command, debug, tmp_path / "short", "--clips", 0, "--frames", 3)["test_000_3_frames.mp4"]
    assert len(short) == 3
    assert short.shape[2] > 2 * 64


def test_what_does_not_exist_or_fit_is_one_line_and_nothing_is_written(
    debug: Path, command: Commands, tmp_path: Path
) -> None:
    np.save(tmp_path / "wide.npy", np.zeros((4, 5)))
    (tmp_path / "text.npy").write_text("no numbers")
    for arguments, words in (
        (("--clips", 0, 7), "--clips: no clip 7 in the test split, which has 0 … 1"),
        (("--clips", 0, "--actions-from", 9), "--actions-from: no clip 9"),
        (
            ("--clips", 0, "--actions", tmp_path / "wide.npy"),
            "wide.npy: shape (4, 5); this model takes (T, 28) with T at least 2",
        ),
        (("--clips", 0, "--actions", tmp_path / "text.npy"), "text.npy: not a readable .npy file"),
        (("--clips", 0, "--fps", 0), "--fps is 0.0"),
        (("--clips", 0, "--frames", 1), "--frames is 1, but the prompt has 1"),
        (("--clips", 0, "--guidance", 2), "model.sample.guidance is 2.0 but the model never saw clips without actions"),
    ):
        assert words in command.refused(PROGRAM, debug, "--out", tmp_path / "out", *arguments)
    assert "is not a run directory" in command.refused(PROGRAM, tmp_path)
    assert not (tmp_path / "out").exists()


def test_weights_of_another_architecture_are_refused(run: Path, command: Commands) -> None:
    wide = toy.world_model_params(toy.with_model(presets.debug(), width=64))
    save_weights(run / "world_model" / "weights", wide)
    line = command.refused(PROGRAM, run, "--clips", 0)
    assert str(run / "world_model" / "weights") in line
    assert "does not fit this configuration" in line


def test_a_split_without_clips_is_named() -> None:
    request = VideoRequest("test", (), None, None, None, {})
    with pytest.raises(UserError, match="^the test split has no clips; choose another with --split$"):
        chosen_clips(request, Source(Path("store"), "test", []))
