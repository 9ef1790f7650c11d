import itertools
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.config import AdamW, EarlyStopConfig, LoopConfig
from rsjax.errors import Preempted
from rsjax.runtime import patient, stop_signals
from rsjax.training.checkpoint import Checkpoints, write_checksums
from rsjax.training.log import read_curve, read_log, read_skipped
from rsjax.training.loop import DivergedError
from rsjax.training.preemption import StopRequest
from rsjax.training.state import TrainState, create_state
from rsjax.training.validation import Validation
from tests.training.toy import Regression, loader, records, train

LOOP = LoopConfig(
    steps=9,
    batch_size=2,
    optimizer=AdamW(learning_rate=1e-2, warmup_steps=2),
    ema=0.9,
    log_every=1,
    checkpoint_every=4,
    sharding="jit",
)


def assert_same(one: TrainState, other: TrainState) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[TrainState, list[dict[str, Any]]]:
    """A run that nothing stopped."""
    directory = tmp_path_factory.mktemp("whole")
    return train(LOOP, directory), read_curve(directory)


def test_a_run_learns_and_logs_every_step(whole: tuple[TrainState, list[dict[str, Any]]]) -> None:
    state, rows = whole
    assert int(state.step) == 9
    assert [row["step"] for row in rows] == list(range(1, 10))
    start = create_state(Regression(), LOOP).params["w"]
    truth = np.array([1.0, -2.0, 0.5])
    assert np.linalg.norm(state.params["w"] - truth) < np.linalg.norm(start - truth)


@pytest.mark.parametrize("stop_at", [4, 6])
def test_resumed_is_never_stopped(whole: tuple[TrainState, list[dict[str, Any]]], tmp_path: Path, stop_at: int) -> None:
    stopped = train(LOOP, tmp_path, stop_at=stop_at)
    assert int(stopped.step) == stop_at
    assert_same(train(LOOP, tmp_path), whole[0])
    assert read_curve(tmp_path) == whole[1]


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
        train(LOOP, tmp_path, model=Regression(to_batch=dies_at_step_7))
    assert [row["step"] for row in read_log(tmp_path)] == [1, 2, 3, 4, 5, 6]  # two more than were saved
    assert_same(train(LOOP, tmp_path), whole[0])
    assert read_curve(tmp_path) == whole[1]


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


def poisoned(*steps: int) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """The batches of these steps have no finite loss; told by how many were made, so not to be resumed."""
    taken = itertools.count(1)
    bad = np.full(2, np.nan, np.float32)
    return lambda arrays: arrays | {"y": bad} if next(taken) in steps else arrays


@pytest.mark.parametrize("every", [1, 100])
def test_steps_that_are_not_finite_are_left_out_and_written_down(tmp_path: Path, every: int) -> None:
    loop = replace(LOOP, log_every=every, skip_budget=2)
    state = train(loop, tmp_path, model=Regression(to_batch=poisoned(3, 7)))
    assert int(state.step) == 9 and int(state.skipped) == 2
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(state))
    rows = read_skipped(tmp_path)
    assert [(row["step"], row["loss"]) for row in rows] == [(3, "nan"), (7, "nan")]
    with loader(rows[1]["data"], records()) as again, loader(None, records()) as batches:
        seventh = [next(batches) for _ in range(7)][-1]
        np.testing.assert_array_equal(next(again)["x"], seventh["x"])
        assert [row["record"] for row in rows[1]["records"]] == seventh["record"].tolist()


def test_one_step_too_many_that_is_not_finite_stops_the_run(tmp_path: Path) -> None:
    loop = replace(LOOP, skip_budget=1, log_every=100, checkpoint_every=2)
    with pytest.raises(DivergedError, match=rf"{tmp_path}: 2 steps were not finite, more than 1 .*step 5"):
        train(loop, tmp_path, model=Regression(to_batch=poisoned(2, 5)))
    assert [row["step"] for row in read_skipped(tmp_path)] == [2, 5]
    assert int(train(loop, tmp_path).step) == 9  # from step 4 on, where nothing is poisoned now
    assert [row["step"] for row in read_skipped(tmp_path)] == [2]


class Steep(Regression):
    """The loss is finite, its gradient is not."""

    def loss_terms(self, params: Any, batch: Any, key: Any, context: Any) -> Any:
        total, weight = super().loss_terms(params, batch, key, context)["error"]
        return {"error": (total + jax.numpy.sqrt(0 * params["b"]), weight)}  # 0, with a gradient of 0·∞


def test_a_gradient_that_is_not_finite_changes_no_parameter(tmp_path: Path) -> None:
    state = train(replace(LOOP, steps=2, ema=0.0), tmp_path, model=Steep())
    assert int(state.skipped) == 2
    jax.tree.map(np.testing.assert_array_equal, state.params, create_state(Steep(), LOOP).params)


def test_sigterm_saves_the_step_under_way_and_the_next_start_goes_on(
    whole: tuple[TrainState, list[dict[str, Any]]], tmp_path: Path
) -> None:
    looked = []

    def look(step: int, weights: Any) -> Validation:
        looked.append(step)
        os.kill(os.getpid(), signal.SIGTERM)
        return Validation(0.0, {})

    with pytest.raises(Preempted, match="saved after step 3; the same command resumes"):
        train(replace(LOOP, eval_every=2), tmp_path, validate=look)
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    assert looked == [2] and checkpoints.latest() == 3
    checkpoints.close()
    assert_same(train(LOOP, tmp_path), whole[0])
    assert [row for row in read_curve(tmp_path) if "loss" in row] == whole[1]


def test_the_last_step_is_written_before_sigterm_is_answered_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish, written = write_checksums, []

    def finish_late(*arguments: Any) -> None:
        time.sleep(0.3)
        finish(*arguments)

    class Watched(StopRequest):
        def __exit__(self, *error: Any) -> None:
            written.append((tmp_path / "checkpoints" / str(LOOP.steps)).exists())
            super().__exit__(*error)

    monkeypatch.setattr("rsjax.training.checkpoint.write_checksums", finish_late)
    monkeypatch.setattr("rsjax.training.loop.StopRequest", Watched)
    train(LOOP, tmp_path)
    assert written == [True]


def test_sigterm_before_the_first_step_has_nothing_to_save(tmp_path: Path) -> None:
    class Stopped(Regression):
        def loss_terms(self, params: Any, batch: Any, key: Any, context: Any) -> Any:
            signal.raise_signal(signal.SIGTERM)  # while the first step is compiled
            return super().loss_terms(params, batch, key, context)

    with stop_signals() as received, pytest.raises(Preempted, match="stopped by SIGTERM; the same command resumes"):
        train(LOOP, tmp_path, model=Stopped())
    assert received == [signal.SIGTERM] and not patient.is_set()


def test_validation_scores_are_logged_drawn_and_decide_which_checkpoints_are_kept(
    whole: tuple[TrainState, list[dict[str, Any]]], tmp_path: Path
) -> None:
    looked = []

    def look(step: int, weights: Any) -> Validation:
        looked.append(jax.tree.map(np.array, weights))
        return Validation(
            abs(step - 4.0), {"validation/loss": abs(step - 4.0)}, {"seen": np.zeros((2, 2, 3), np.uint8)}
        )

    loop = replace(LOOP, eval_every=2, checkpoint_every=2, keep_last=1)
    state = train(loop, tmp_path, per_step=("clips", 2), validate=look)
    assert_same(state, whole[0])
    jax.tree.map(np.testing.assert_array_equal, looked[-1], state.ema)
    rows = [row for row in read_log(tmp_path) if "validation/loss" in row]
    assert [(row["step"], row["validation/loss"]) for row in rows] == [(2, 2), (4, 0), (6, 2), (8, 4), (9, 5)]
    assert len(list((tmp_path / "pictures").glob("seen-*.png"))) == 5
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    assert checkpoints.steps() == [4, 9]
    checkpoints.close()
    assert all(row["clips_per_second"] > 0 for row in read_log(tmp_path) if "loss" in row)


def test_batches_follow_from_the_loaders_state(tmp_path: Path) -> None:
    """The place in the data is saved with the state: what a resumed run reads is what comes next."""
    seen: list[np.ndarray] = []

    def watch(arrays: dict[str, Any]) -> dict[str, Any]:
        seen.append(arrays["x"])
        return arrays

    train(LOOP, tmp_path, model=Regression(to_batch=watch), stop_at=4)
    first = len(seen)  # some were made ahead
    train(LOOP, tmp_path, model=Regression(to_batch=watch))
    with loader(None, records()) as batches:
        expected = [next(batches)["x"] for _ in range(9)]
    np.testing.assert_array_equal(seen[:4], expected[:4])
    np.testing.assert_array_equal(seen[first : first + 5], expected[4:])


def rising_after(best: int) -> Callable[[int, Any], Validation]:
    """A validation whose metric falls up to a step, and rises from there on."""
    return lambda step, weights: Validation(abs(step - best), {})


@pytest.mark.parametrize("stop_at", [0, 5])
def test_an_early_stop_uses_the_best_weights_killed_or_not(tmp_path: Path, stop_at: int) -> None:
    early = replace(LOOP, steps=20, checkpoint_every=1, keep_last=1, early_stop=EarlyStopConfig(every=1, patience=3))
    if stop_at:
        train(early, tmp_path, validate=rising_after(3), stop_at=stop_at)
    stopped = train(early, tmp_path, validate=rising_after(3))
    assert Checkpoints(tmp_path / "checkpoints").steps() == [3, 6]
    best = train(replace(LOOP, steps=20), tmp_path / "best", stop_at=3)
    assert_same(stopped, best)


def test_an_early_stop_ends_no_stage_of_a_curriculum_but_the_last(tmp_path: Path) -> None:
    early = replace(LOOP, steps=20, checkpoint_every=1, keep_last=1, early_stop=EarlyStopConfig(every=1, patience=3))
    train(replace(early, last_stage=7), tmp_path, validate=rising_after(3))
    assert Checkpoints(tmp_path / "checkpoints").steps() == [3, 10]
