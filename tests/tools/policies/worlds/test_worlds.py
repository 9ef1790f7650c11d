import re
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.errors import UserError
from rsjax.evaluation.results import fingerprint
from rsjax.models.base import WorldModel
from rsjax.tools.policies.studies.trials import Trials, first_frames, try_policy
from rsjax.tools.policies.worlds.actions import ActionError
from rsjax.tools.policies.worlds.model_world import FirstFrame, ModelWorld
from rsjax.tools.policies.worlds.simulator_world import SimulatorWorld
from rsjax.tools.policies.worlds.world import run_episodes
from tests.tools.policies.toy import CONTROLS, WIDTH, picture
from tests.tools.policies.toy_worlds import (
    ToyPolicy,
    ToySimulator,
    action_range,
    imagined,
    judge,
    simulated,
    trained_like,
)

STARTS = [0, 3, 1]  # seeds; the dot begins in that column and is done in column 10


def frames(places: list[int]) -> list[FirstFrame]:
    return [FirstFrame(picture(place), np.ones((16, 16), np.float32), 7 + place) for place in places]


@pytest.mark.parametrize("kind", ["simulated", "imagined"])
def test_episodes_end_when_each_succeeds(kind: str) -> None:
    world: Any = simulated(3) if kind == "simulated" else imagined(4)  # one more than needed
    starts: Any = STARTS if kind == "simulated" else frames(STARTS)
    episodes = run_episodes(world, ToyPolicy(1.0).actor(), starts, 9)
    assert [len(one.rgb) for one in episodes] == [6, 5, 6]  # 2 columns a frame
    for one, begins in zip(episodes, STARTS, strict=True):
        assert one.success[-1] and not one.success[:-1].any() and one.clipped == 0
        assert not one.actions[0].any() and (one.actions[1:].reshape(-1, 2, 3)[..., 0] == 1).all()
        assert one.depth is not None and len(one.depth) == len(one.actions) == len(one.rgb)
        for step, frame in enumerate(one.rgb):
            np.testing.assert_array_equal(frame, picture(begins + 2 * step))
    slow = run_episodes(world, ToyPolicy(0.1).actor(), starts, 4)
    assert [len(one.rgb) for one in slow] == [5, 5, 5] and not any(one.success.any() for one in slow)


def test_a_first_frame_that_looks_like_success_ends_nothing() -> None:
    world = imagined(2)
    one, other = run_episodes(world, ToyPolicy(0.1).actor(), frames([10, 0]), 4)
    assert one.success.tolist() == [False, True] and len(other.rgb) == 5


@pytest.mark.parametrize("uses_depth", [False, True])
def test_a_family_that_generates_whole_videos_goes_on_from_its_last_frames(uses_depth: bool) -> None:
    calls: list[Any] = []

    class Whole:
        """Brightens the last given frame by the last action; its frames are even numbers, as it sees them.

        If it uses depth, everything is a metre further away in each frame.
        """

        imagine = WorldModel.imagine

        def reconstruct(self, assets: Any, video: Video) -> Video:
            assert (video.depth is not None) == uses_depth
            return Video(video.rgb // 2 * 2, video.depth)

        def generate(self, params: Any, assets: Any, prompt: Video, actions: Any, *, index: Any, depth: bool) -> Video:
            calls.append((prompt.rgb.shape[1], actions[0, :, 0].tolist(), index.tolist()))
            last = prompt.rgb[:, -1:] + actions[:, -1, 0].astype(np.uint8)[:, None, None, None, None]
            rgb = np.concatenate([prompt.rgb, last], axis=1)
            assert depth == uses_depth
            if prompt.depth is None:
                return Video(rgb)
            return Video(rgb, np.concatenate([prompt.depth, prompt.depth[:, -1:] + 1], axis=1))

    world = ModelWorld(trained_like(Whole(), {}, uses_depth), 3, judge, action_range(9.0))  # one more than needed
    given = iter(range(1, 9))
    for _ in range(2):  # the second time nothing of the first is left
        calls.clear()
        metres = np.ones((16, 16), np.float32)
        starts = [FirstFrame(np.full((16, 16, 3), level, np.uint8), metres, level) for level in (11, 20)]
        one, other = run_episodes(world, lambda observation: np.full((2, 6), next(given), np.float32), starts, 4)
        steps = one.actions[:, 0].tolist()
        assert one.rgb[:, 0, 0, 0].tolist() == (10 + np.cumsum(steps)).tolist()
        assert other.rgb[:, 0, 0, 0].tolist() == (20 + np.cumsum(steps)).tolist()
        assert (one.depth is not None) == uses_depth
        if one.depth is not None:
            assert one.depth[:, 0, 0].tolist() == [1, 2, 3, 4, 5]
        assert [length for length, _, _ in calls] == [1, 2, 2, 2]
        assert [rows for _, rows, _ in calls] == [steps[:2], steps[:3], steps[1:4], steps[2:]]
        assert len({number for _, _, index in calls for number in index[:2]}) == 8  # draws of its own for each frame
        assert calls[0][2] == [11, 20, 20]


@pytest.mark.parametrize("kind", ["simulated", "imagined"])
def test_actions_out_of_range_are_clipped_and_counted(kind: str) -> None:
    world: Any = simulated(2) if kind == "simulated" else imagined(2)
    starts: Any = [0, 4] if kind == "simulated" else frames([0, 4])
    episodes = run_episodes(world, ToyPolicy(3.0).actor(), starts, 9)
    assert [len(one.rgb) - 1 for one in episodes] == [5, 3]
    assert [one.clipped for one in episodes] == [10, 6]  # both controls of each step


@pytest.mark.parametrize("kind", ["simulated", "imagined"])
@pytest.mark.parametrize("shape", [(1, 6), (3, 6), (7, 6), (2, 5), (2, 2, 3)])
def test_answers_of_another_shape_are_named(kind: str, shape: tuple[int, ...]) -> None:
    world: Any = simulated(4) if kind == "simulated" else imagined(4)
    starts: Any = [0, 4] if kind == "simulated" else frames([0, 4])
    with pytest.raises(
        ActionError, match=rf"actions have shape {re.escape(str(shape))}; expected \(2, 6\), 6-D change"
    ):
        run_episodes(world, lambda observation: np.zeros(shape, np.float32), starts, 3)


def test_a_simulation_that_diverges_ends_no_other_episode(capsys: pytest.CaptureFixture[str]) -> None:
    simulators: Any = [ToySimulator(), ToySimulator(diverges=True)]
    world = SimulatorWorld(simulators, CONTROLS, WIDTH)
    one, other = run_episodes(world, ToyPolicy(1.0).actor(), [0, 3], 9)
    assert one.success[-1] and not other.success.any()
    np.testing.assert_array_equal(other.rgb, np.repeat(picture(3)[None], 10, 0))
    assert capsys.readouterr().out.count("the simulation diverged; the episode stays as it was") == 1
    simulators[1].diverges = False
    assert all(each.success[-1] for each in run_episodes(world, ToyPolicy(1.0).actor(), [0, 3], 9))


def test_the_worlds_begin_with_the_same_frames(tmp_path: Path) -> None:
    world, model = simulated(2), imagined(2)
    found = first_frames(world, STARTS, tmp_path / "starts.npz")
    kept: Any = SimpleNamespace(key=world.key)  # nothing is rendered again
    again = first_frames(kept, STARTS, tmp_path / "starts.npz")
    with pytest.raises(AttributeError, match="count"):  # another simulator would render
        first_frames(SimpleNamespace(key="another"), STARTS, tmp_path / "starts.npz")  # type: ignore[arg-type]
    for one, other, place in zip(found, again, STARTS, strict=True):
        np.testing.assert_array_equal(one.rgb, picture(place))
        np.testing.assert_array_equal(one.rgb, other.rgb)
        np.testing.assert_array_equal(one.depth, other.depth)
    np.testing.assert_array_equal(model.reset(found[:1]).observation["rgb"], picture(0)[None])


@dataclass(frozen=True)
class Interrupted(ToyPolicy):
    """A policy that remembers the seeds of its actors, and is interrupted at one of them."""

    at: int = -1
    begun: list[int] = field(default_factory=list)

    def actor(self, seed: int = 0) -> Any:
        self.begun.append(seed)
        if seed == self.at:
            raise KeyboardInterrupt
        return super().actor(seed)


def test_trials_that_are_interrupted_go_on(tmp_path: Path) -> None:
    trials = Trials(episodes=5, max_steps=4, together=2, videos=1)
    starts = [0, 3, 1, 4, 2]  # with 4 steps of 2 columns, seeds 3, 4 and 2 come to column 10

    policy: Any = Interrupted(1.0, at=2)
    with pytest.raises(KeyboardInterrupt):
        try_policy(policy, simulated(2), starts, trials, tmp_path, "toy")
    policy = Interrupted(1.0, at=-1)
    result = try_policy(policy, simulated(2), starts, trials, tmp_path, "toy")
    assert policy.begun == [2, 4]  # the group that was cut short is run again, the first one is not
    assert result.success == [False, True, False, True, True]
    assert [path.name for path in tmp_path.glob("*.mp4")] == ["episode-00.mp4"]
    with pytest.raises(UserError, match="holds trials of other episodes or steps"):
        try_policy(ToyPolicy(1.0), simulated(2), starts, Trials(5, 9, 2), tmp_path, "toy")  # type: ignore[arg-type]


def test_keys_of_arrays_change_with_their_numbers() -> None:
    params = {"x": np.arange(3, dtype=np.float32), "s": np.float32(1), "none": None}
    assert fingerprint(params) == fingerprint(dict(params))
    assert fingerprint(params) != fingerprint(params | {"s": np.float32(2)})
