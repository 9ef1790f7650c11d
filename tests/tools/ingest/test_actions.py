import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rsjax.config import ConfigError
from rsjax.tools.ingest.actions import (
    ActionConfig,
    ActionLayout,
    align_actions,
    continuous_signs,
    describe_dimensions,
    described_layout,
    flat_names,
    layout_of,
    sampled_actions,
)
from rsjax.tools.ingest.episode import EpisodeError

FLOATS = st.floats(-10, 10, width=32)
ROWS = hnp.arrays(np.float32, st.tuples(st.integers(2, 20), st.integers(1, 4)), elements=FLOATS)
EVERY = ActionConfig()
COUNT = 60


def turn(axis: int, angle: float) -> np.ndarray:
    quaternion = np.zeros(4)
    quaternion[axis] = np.sin(angle / 2)
    quaternion[3] = np.cos(angle / 2)
    return quaternion


def test_a_command_leads_into_the_next_frame() -> None:
    np.testing.assert_array_equal(align_actions(np.array([[1.0], [2.0], [3.0]])), [[0], [1], [2]])
    assert align_actions(np.array([[7.0]])).tolist() == [[0]]
    np.testing.assert_array_equal(align_actions(np.array([[1.0], [2.0], [3.0]]), after=True), [[1], [2], [3]])


@given(ROWS)
def test_every_frame_sampled_changes_nothing(rows: np.ndarray) -> None:
    rows = align_actions(rows)
    for layout in (ActionLayout("delta"), ActionLayout("absolute"), ActionLayout("delta", held=(0,))):
        np.testing.assert_array_equal(sampled_actions(rows, np.arange(len(rows)), EVERY, layout), rows)


@given(ROWS, st.integers(1, 6))
def test_deltas_of_skipped_frames_add_up_to_the_same_way(rows: np.ndarray, step: int) -> None:
    frames = np.arange(0, len(rows), step)
    made = sampled_actions(rows, frames, EVERY, ActionLayout("delta"))
    np.testing.assert_allclose(made.sum(0), rows[1 : frames[-1] + 1].sum(0, dtype=np.float64), atol=1e-3)


@given(ROWS, st.integers(1, 6))
def test_differences_lead_from_one_place_to_the_other(rows: np.ndarray, step: int) -> None:
    frames = np.arange(0, len(rows), step)
    made = sampled_actions(rows, frames, ActionConfig(kind="delta"), ActionLayout("absolute"))
    first = int(not rows[0].any())  # without a row 0, the first place known is the one led into frame 1
    start = rows[first].astype(np.float64)
    np.testing.assert_allclose((start + made.cumsum(0, dtype=np.float64))[1:], rows[frames[1:]], atol=1e-3)


def test_differences_of_angles_go_across_pi() -> None:
    rows = np.array([[3.0, 3.0], [3.1, 3.1], [-3.1, -3.1], [3.1, 3.1]], np.float32)
    made = sampled_actions(rows, np.arange(4), ActionConfig(kind="delta"), ActionLayout("absolute", angles=(0,)))
    np.testing.assert_allclose(made[:, 0], [0, 0.1, 2 * np.pi - 6.2, 6.2 - 2 * np.pi], atol=1e-5)
    np.testing.assert_allclose(made[:, 1], [0, 0.1, -6.2, 6.2], atol=1e-5)
    joined = sampled_actions(rows, np.array([0, 2]), ActionConfig(kind="delta"), ActionLayout("absolute", angles=(0,)))
    np.testing.assert_allclose(joined[1], [2 * np.pi - 6.1, -6.1], atol=1e-5)


def test_places_and_held_dimensions_keep_the_last_command() -> None:
    rows = np.array([[0, 0], [1, 0], [2, 1], [3, 1], [4, 0]], np.float32)
    frames = np.array([0, 2, 4])
    assert sampled_actions(rows, frames, EVERY, ActionLayout("absolute")).tolist() == [[0, 0], [2, 1], [4, 0]]
    assert sampled_actions(rows, frames, EVERY, ActionLayout("delta", held=(1,))).tolist() == [[0, 0], [3, 1], [7, 0]]
    changed = sampled_actions(rows, frames, ActionConfig(kind="delta"), ActionLayout("absolute", held=(1,)))
    assert changed.tolist() == [[0, 0], [1, 1], [2, 0]]
    last = sampled_actions(rows, frames, ActionConfig(compose="last"), ActionLayout("delta"))
    assert last.tolist() == [[0, 0], [2, 1], [4, 0]]


def test_stacked_rows_are_all_there() -> None:
    rows = np.arange(14, dtype=np.float32).reshape(7, 2)
    made = sampled_actions(rows, np.array([0, 3, 6]), ActionConfig(compose="stack"), ActionLayout())
    np.testing.assert_array_equal(made[1:], rows[1:].reshape(2, 6))
    assert not made[0].any()
    with pytest.raises(ConfigError, match="'stack', but frames are 1 to 3 apart"):
        sampled_actions(rows, np.array([0, 1, 4]), ActionConfig(compose="stack"), ActionLayout())


def test_an_offset_moves_commands_to_where_they_act() -> None:
    rows = np.array([[0], [1], [2], [3], [4]], np.float32)
    frames = np.arange(5)
    late = sampled_actions(rows, frames, ActionConfig(offset=-1), ActionLayout("absolute"))
    early = sampled_actions(rows, frames, ActionConfig(offset=1), ActionLayout("absolute"))
    assert late[:, 0].tolist() == [0, 2, 3, 4, 4]
    assert early[:, 0].tolist() == [0, 1, 1, 2, 3]
    steps = sampled_actions(rows, frames, ActionConfig(offset=-2), ActionLayout("delta"))
    assert steps[:, 0].tolist() == [0, 3, 4, 0, 0]
    known = sampled_actions(rows + 7, frames, ActionConfig(offset=1), ActionLayout("delta"))
    assert known[:, 0].tolist() == [0, 7, 8, 9, 10]  # with row 0, which led into frame 0


@given(st.lists(st.tuples(st.integers(0, 2), st.floats(-0.3, 0.3)), min_size=6, max_size=6))
def test_turns_join_to_the_turn_from_end_to_end(turns: list[tuple[int, float]]) -> None:
    scipy = pytest.importorskip("scipy.spatial.transform")
    poses = [scipy.Rotation.identity()]
    for axis, angle in turns:
        poses.append(poses[-1] * scipy.Rotation.from_quat(turn(axis, angle)))
    places = np.stack([pose.as_quat() for pose in poses]).astype(np.float32)
    steps = np.stack([np.zeros(4), *(turn(axis, angle) for axis, angle in turns)]).astype(np.float32)
    frames = np.array([1, 4, 6])
    layout = (0,)
    expected = np.stack([(poses[1].inv() * poses[4]).as_quat(True), (poses[4].inv() * poses[6]).as_quat(True)])
    joined = sampled_actions(steps, frames, EVERY, ActionLayout("delta", layout))
    differences = sampled_actions(places, frames, ActionConfig(kind="delta"), ActionLayout("absolute", layout))
    np.testing.assert_allclose(joined[1:], expected, atol=1e-5)
    np.testing.assert_allclose(differences[1:], expected, atol=1e-5)


@given(st.lists(st.booleans(), min_size=1, max_size=20))
def test_flipped_signs_of_a_turning_hand_are_undone(flips: list[bool]) -> None:
    smooth = np.stack([turn(0, 0.2 * step) for step in range(len(flips))])
    signs = np.where(flips, -1.0, 1.0)[:, None]
    mended = continuous_signs(smooth * signs)
    np.testing.assert_array_equal(mended, smooth * signs[0])


@given(st.lists(st.booleans(), min_size=6, max_size=6), st.sampled_from(["join", "last", "stack"]))
def test_signs_of_quaternions_do_not_change_what_leads_from_one_to_the_other(flips: list[bool], compose: str) -> None:
    smooth = np.stack([turn(1, 0.3 * step) for step in range(6)]).astype(np.float32)
    signs = np.where(flips, -1.0, 1.0)[:, None].astype(np.float32)
    config = ActionConfig(compose=compose, kind="delta")  # type: ignore[arg-type]
    frames = np.arange(1, 6, 2)
    layout = ActionLayout("absolute", (0,))
    made = sampled_actions(smooth * signs, frames, config, layout)
    np.testing.assert_allclose(made, sampled_actions(smooth, frames, config, layout), atol=1e-6)


def test_what_does_not_fit_is_reported() -> None:
    rows = np.zeros((3, 2), np.float32)
    with pytest.raises(ConfigError, match="actions.compose is 'sum'; choose one of join, last, stack"):
        ActionConfig(compose="sum")  # type: ignore[arg-type]
    for config, layout, message in (
        (ActionConfig(kind="absolute"), ActionLayout("delta"), "the source records deltas"),
        (EVERY, ActionLayout("absolute", quaternions=(2,)), "names dimension 2, but actions have 2"),
        (EVERY, ActionLayout("delta", held=(-1,)), "names dimension -1, but actions have 2"),
        (EVERY, ActionLayout("delta", angles=(2,)), "angles names dimension 2, but actions have 2"),
    ):
        with pytest.raises((ConfigError, EpisodeError), match=message):
            sampled_actions(rows, np.arange(3), config, layout)


def test_a_layout_survives_json() -> None:
    for angles in ((), (3, 4)):
        layout = ActionLayout("absolute", (6, 10), (14, 15), angles=angles)
        assert ActionLayout.from_json(json.loads(json.dumps(layout.to_json()))) == layout
        assert ("angles" in layout.to_json()) == bool(angles)
    assert ActionLayout.from_json({}) == ActionLayout()


def doubts(values: np.ndarray, name: str = "x") -> tuple[str, ...]:
    rows = np.concatenate([np.zeros(1), values])[:, None].astype(np.float32)
    return layout_of(rows, "delta", None, names=[name]).unclear


@pytest.mark.parametrize(
    ("values", "name", "why"),
    [
        (np.arange(COUNT) > 30, "x", "is never anything but 0 or 1"),
        (np.where(np.arange(COUNT) > 30, 1, -1), "x", "is never anything but -1 or 1"),
        (np.ones(COUNT), "x", "is never anything but 1"),
        (np.linspace(0, 0.08, COUNT), "Gripper_pos", "is a gripper"),
        (np.linspace(-1.2, -0.8, COUNT), "joint", "never comes near zero (-1.2 to -0.8)"),
    ],
)
def test_what_cannot_be_a_step_is_named(values: np.ndarray, name: str, why: str) -> None:
    assert doubts(values, name) == (f"dimension 0 ({name}) {why}",)


def test_targets_are_known_by_the_state() -> None:
    steps = np.random.default_rng(0).normal(0, 0.01, (COUNT, 2)).astype(np.float32)
    path = np.cumsum(steps, 0)  # passes zero
    target = np.concatenate([path[1:], path[-1:]])
    near = [doubt.endswith("is nearly the state") for doubt in layout_of(target, None, None, states=path).unclear]
    assert near == [True, True]
    assert layout_of(steps, None, None, states=path).unclear == ()


@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 10), st.integers(8, 80))
def test_steps_that_stop_now_and_then_pass(seed: int, size: float, count: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(0, size, count)
    values[rng.integers(1, count)] = 0
    path = np.cumsum(values)[:, None]
    assert doubts(values) == () and doubts(np.zeros(count)) == ()
    assert layout_of(values[:, None], "delta", None, states=path + 9 * size * count).unclear == ()


def test_names_of_dimensions() -> None:
    assert flat_names({"motors": ["a", "b"]}, 2) == flat_names([["a", "b"]], 2) == ["a", "b"]
    assert flat_names({"a": 0, "b": 1}, 2) == ["a", "b"]
    assert flat_names(["a"], 2) == flat_names(None, 2) == flat_names({"motors": 3}, 2) == []


def test_each_dimension_is_described() -> None:
    layout = ActionLayout("absolute", (0,), (4,))
    names = ["x", "y", "z", "w", "grip"]
    assert describe_dimensions(layout, names, ActionConfig(), 5)[3:] == ["w (absolute, of a quaternion)", "grip (held)"]
    assert describe_dimensions(layout, (), ActionConfig(kind="delta"), 5)[3:] == ["(delta, of a quaternion)", "(held)"]
    stacked = describe_dimensions(ActionLayout("undeclared"), ["x"], ActionConfig(compose="stack"), 2)
    assert stacked == ["x (undeclared, row 0)", "x (undeclared, row 1)"]
    turns = ActionLayout("absolute", held=(2,), angles=(1,))
    described = describe_dimensions(turns, ["x", "yaw", "grip"], ActionConfig(), 3)
    assert described == ["x (absolute)", "yaw (absolute, an angle)", "grip (held)"]
    assert described_layout(described) == turns
