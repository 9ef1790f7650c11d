"""Toy recordings in which a square moves as a command says, some recorded frames after it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsjax.tools.finetune.delay import Delay, measure_delay
from rsjax.tools.finetune.recordings import Cutting, Recordings, ingest_options
from rsjax.tools.ingest.actions import ActionConfig
from rsjax.tools.ingest.episode import Episode
from rsjax.tools.ingest.pictures import ArrayFrames

FRAMES = 24
EPISODES = 5
CUTTING = Cutting(delay=-1, test_share=0.2, validation_share=0.2, workers=0)


def recorded(delay: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns pictures, and aligned commands: row t moves the square into frame t + ``delay``, with a little noise."""
    rng = np.random.default_rng(seed)
    commands = rng.choice([-4.0, 0.0, 4.0], size=(FRAMES, 2))
    commands[0] = 0
    moves = np.zeros_like(commands)
    moves[delay:] = commands[: FRAMES - delay]
    corners = np.clip(24 + np.cumsum(moves, axis=0), 0, 48).astype(int)
    texture = rng.integers(100, 256, (16, 16, 3), np.uint8)
    pictures = np.zeros((FRAMES, 64, 64, 3), np.uint8)
    for picture, (x, y) in zip(pictures, corners, strict=True):
        picture[y : y + 16, x : x + 16] = texture
    return pictures, (commands + rng.normal(0, 0.1, commands.shape)).astype(np.float32)


def episodes(delay: int, kind: str = "delta") -> list[Episode]:
    made = []
    for seed in range(EPISODES):
        pictures, commands = recorded(delay, seed)
        if kind == "absolute":
            commands = np.cumsum(commands, axis=0)
        meta: dict[str, Any] = {"actions": {"kind": kind}}
        cameras = {"front": ArrayFrames(pictures)}
        times = np.arange(FRAMES) / 5.0
        made.append(Episode(str(seed), "0" * 16, "", 5.0, times, commands, None, cameras, meta=meta))
    return made


@pytest.mark.parametrize("delay", [0, 2])
def test_the_delay_is_that_of_the_motion(delay: int) -> None:
    measured = measure_delay(episodes(delay), "", every=1)
    assert measured.frames == delay
    assert np.argmax(measured.explained) == delay
    assert measured.explained[delay] > 0.5


def test_targets_count_by_their_change() -> None:
    assert measure_delay(episodes(1, "absolute"), "", every=1).frames == 1


def test_a_delay_of_part_of_a_clips_step_is_found() -> None:
    measured = measure_delay(episodes(1), "", every=2)
    assert len(measured.explained) == 5
    assert measured.frames == 1


def test_nothing_is_moved_without_a_cause() -> None:
    unrelated = [replace(one, actions=other.actions) for one, other in zip(episodes(0), episodes(0)[::-1], strict=True)]
    assert measure_delay(unrelated[:2] + unrelated[3:], "", every=1).frames == 0
    still = [
        replace(one, cameras={"front": ArrayFrames(np.zeros((FRAMES, 64, 64, 3), np.uint8))}) for one in episodes(0)
    ]
    assert measure_delay(still, "", every=1).frames == 0
    assert measure_delay(episodes(1)[:2], "", every=1) == Delay(())
    assert Delay((0.38, 0.43)).frames == 0


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings at 5 Hz whose commands act one frame late."""
    folder = tmp_path_factory.mktemp("late")
    for seed in range(EPISODES):
        pictures, commands = recorded(1, seed)
        np.savez(folder / f"{seed}.npz", frames=pictures, actions=commands[1:], fps=5.0)
    return folder


def test_clips_have_commands_where_they_act(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def chosen(cutting: Cutting) -> ActionConfig:
        return ingest_options(Recordings("npz", data), cutting, 64, 16, Path("out")).actions

    declared = replace(CUTTING, option=("kind=delta",))
    assert chosen(declared) == ActionConfig(offset=1)
    assert "if they act 1 recorded frame later" in capsys.readouterr().out
    assert chosen(replace(declared, delay=0)) == ActionConfig()
    assert chosen(replace(declared, delay=2)) == ActionConfig(offset=2)
    assert chosen(CUTTING) == ActionConfig()  # nobody says what the numbers mean
