from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.config import LoopConfig, OptimizerConfig
from rsjax.train.checkpoint import Checkpoints
from rsjax.train.log import read_log
from rsjax.train.loop import DivergedError
from rsjax.train.state import TrainState, create_state
from tests.train.toy import Regression, loader, records, train

LOOP = LoopConfig(
    steps=9,
    batch_size=2,
    optimizer=OptimizerConfig(learning_rate=1e-2, warmup_steps=2),
    ema=0.9,
    log_every=1,
    checkpoint_every=4,
    placement="jit",
)


def assert_same(one: TrainState, other: TrainState) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def logged(directory: Path) -> list[dict[str, Any]]:
    """The log without its clock."""
    return [
        {k: v for k, v in row.items() if k not in ("seconds_per_step", "data_wait_share")}
        for row in read_log(directory)
    ]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[TrainState, list[dict[str, Any]]]:
    """A run that nothing stopped."""
    directory = tmp_path_factory.mktemp("whole")
    return train(LOOP, directory), logged(directory)


def test_a_run_learns_and_logs_every_step(whole: tuple[TrainState, list[dict[str, Any]]]) -> None:
    state, rows = whole
    assert int(state.step) == 9
    assert [row["step"] for row in rows] == list(range(1, 10))
    start = create_state(Regression(), LOOP).params["w"]
    truth = np.array([1.0, -2.0, 0.5])
    assert np.linalg.norm(state.params["w"] - truth) < np.linalg.norm(start - truth)


@pytest.mark.parametrize("stop_at", [1, 4, 6])
def test_resumed_is_never_stopped(whole: tuple[TrainState, list[dict[str, Any]]], tmp_path: Path, stop_at: int) -> None:
    stopped = train(LOOP, tmp_path, stop_at=stop_at)
    assert int(stopped.step) == stop_at
    assert_same(train(LOOP, tmp_path), whole[0])
    assert logged(tmp_path) == whole[1]


def test_a_killed_run_goes_on_from_its_last_checkpoint(
    whole: tuple[TrainState, list[dict[str, Any]]], tmp_path: Path
) -> None:
    taken = 0

    def dies_at_step_7(arrays: dict[str, Any]) -> dict[str, Any]:
        nonlocal taken
        taken += 1
        if taken == 7:
            raise KeyboardInterrupt
        return arrays

    with pytest.raises(KeyboardInterrupt):
        train(LOOP, tmp_path, to_batch=dies_at_step_7)
    assert [row["step"] for row in read_log(tmp_path)] == [1, 2, 3, 4, 5, 6]  # two more than were saved
    assert_same(train(LOOP, tmp_path), whole[0])
    assert logged(tmp_path) == whole[1]


def test_a_finished_run_is_left_as_it_is(whole: tuple[TrainState, list[dict[str, Any]]], tmp_path: Path) -> None:
    train(LOOP, tmp_path)
    rows = read_log(tmp_path)
    assert_same(train(LOOP, tmp_path), whole[0])
    assert read_log(tmp_path) == rows


def test_without_resume_a_run_starts_again(tmp_path: Path) -> None:
    train(LOOP, tmp_path, stop_at=4)
    again = train(LOOP, tmp_path, resume=False, stop_at=2)
    assert int(again.step) == 2
    assert [row["step"] for row in read_log(tmp_path)] == [1, 2]


class Exploding(Regression):
    """From some step on the loss, or only its gradient, is not a number."""

    def terms(self, params: Any, batch: Any, key: Any, around: Any) -> Any:
        total, weight = super().terms(params, batch, key, around)["error"]
        return {"error": (total + self.poison(params), weight)}

    def poison(self, params: Any) -> Any:
        return jax.numpy.sqrt(0 * params["b"])  # 0, with a gradient of 0·∞


def test_a_loss_that_is_not_a_number_stops_the_run_before_it_is_saved(tmp_path: Path) -> None:
    rare = replace(LOOP, log_every=100, checkpoint_every=2)
    taken = 0

    def poisoned(arrays: dict[str, Any]) -> dict[str, Any]:
        nonlocal taken
        taken += 1
        return arrays | {"y": np.full(2, np.nan, np.float32)} if taken == 3 else arrays

    with pytest.raises(DivergedError, match=rf"{tmp_path}: loss is nan at step 4; lower the learning rate"):
        train(rare, tmp_path, to_batch=poisoned)
    assert_last_checkpoint_is_sound(tmp_path, 2)
    assert int(train(rare, tmp_path).step) == 9


def test_parameters_that_are_not_numbers_are_not_saved_though_the_loss_still_is_one(tmp_path: Path) -> None:
    with pytest.raises(DivergedError, match="param_norm is nan at step 1;"):
        train(LOOP, tmp_path, objective=Exploding())
    assert_last_checkpoint_is_sound(tmp_path, None)


def assert_last_checkpoint_is_sound(directory: Path, step: int | None) -> None:
    checkpoints = Checkpoints(directory / "checkpoints")
    assert checkpoints.latest() == step
    if step is not None:
        state, _ = checkpoints.restore(create_state(Regression(), LOOP))
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(state))
    checkpoints.close()


def test_batches_follow_from_the_loaders_state(tmp_path: Path) -> None:
    """The place in the data is saved with the state: what a resumed run reads is what comes next."""
    seen: list[np.ndarray] = []

    def watch(arrays: dict[str, Any]) -> dict[str, Any]:
        seen.append(arrays["x"])
        return arrays

    train(LOOP, tmp_path, to_batch=watch, stop_at=4)
    train(LOOP, tmp_path, to_batch=watch)
    with loader(None, records()) as batches:
        np.testing.assert_array_equal(seen, [next(batches)["x"] for _ in range(9)])
