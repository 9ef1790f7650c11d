import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.tools.ingest.actions import (
    ActionConfig,
    ActionLayout,
    Kind,
    check_declared,
    describe_dimensions,
    described_layout,
    flat_names,
    layout_of,
)
from rsjax.tools.ingest.episode import EpisodeError

COUNT = 60
STEPS = np.random.default_rng(0).normal(0, 0.01, (COUNT, 2)).astype(np.float32)


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
    path = np.cumsum(STEPS, 0)  # passes zero
    target = np.concatenate([path[1:], path[-1:]])
    near = [doubt.endswith("is nearly the state") for doubt in layout_of(target, None, None, states=path).unclear]
    assert near == [True, True]
    assert layout_of(STEPS, None, None, states=path).unclear == ()


@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 10), st.integers(8, 80))
def test_steps_that_stop_now_and_then_pass(seed: int, size: float, count: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(0, size, count)
    values[rng.integers(1, count)] = 0
    path = np.cumsum(values)[:, None]
    assert doubts(values) == () and doubts(np.zeros(count)) == ()
    assert layout_of(values[:, None], "delta", None, states=path + 9 * size * count).unclear == ()


def test_what_is_declared_is_believed() -> None:
    grip = (np.arange(COUNT) > 30)[:, None].astype(np.float32)
    assert layout_of(grip, "delta", ()) == ActionLayout("delta")
    assert layout_of(grip, "delta", (0,)) == ActionLayout("delta", held=(0,))
    assert layout_of(grip, "absolute", None) == ActionLayout("absolute")
    assert layout_of(grip, None, None).kind == "undeclared"


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


def test_a_refusal_names_the_dimension_and_no_number_that_could_be_mistaken_for_it() -> None:
    rows = np.zeros((8, 2), np.float32)
    rows[4:, 1] = 1
    cases: list[tuple[Kind | None, str]] = [
        ("delta", r"dimension 1 is never anything but 0 or 1; say --option 'held=\[…\]' with the numbers"),
        (None, r"say --option kind=delta .*these cannot be steps: dimension 1 is never anything but 0 or 1"),
    ]
    for kind, message in cases:
        with pytest.raises(EpisodeError, match=message):
            check_declared(layout_of(rows, kind, None), 5, ActionConfig())
