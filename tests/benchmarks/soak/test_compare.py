import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.soak.compare import compare_arrays, compare_logs, compare_stages, json_lines, read_arrays, same_bits
from rsjax.config import LoopConfig
from rsjax.training.checkpoint import save_weights
from tests.training.toy import train


def floats(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


NAN, OTHER_NAN = np.array([0x7FC00000, 0x7FC00001], np.uint32).view(np.float32)[:, None]


@pytest.mark.parametrize(
    ("one", "two", "same"),
    [
        (NAN, NAN, True),
        (NAN, OTHER_NAN, False),
        (floats(0.0), floats(-0.0), False),
        (floats(1.0), np.nextafter(floats(1.0), floats(2.0)), False),
        (floats(1.0), np.array([1.0]), False),
        (floats(1.0), floats(1.0)[None], False),
    ],
)
def test_the_same_is_the_same_in_every_bit(one: np.ndarray, two: np.ndarray, same: bool) -> None:
    assert same_bits(one, two) is same


def log(folder: Path, rows: list[dict[str, Any]]) -> Path:
    folder.mkdir()
    (folder / "log.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def test_the_first_step_that_differs_is_named_and_measurements_are_not_compared(tmp_path: Path) -> None:
    rows = [{"step": step, "loss": float("nan") if step == 2 else 1 / step} for step in range(1, 5)]
    timed = [row | {"seconds_per_step": 0.1 * row["step"]} for row in rows]
    changed = [row | ({"loss": 7.0} if row["step"] > 2 else {}) for row in rows]
    one = log(tmp_path / "one", rows)
    assert compare_logs(one, log(tmp_path / "timed", timed)) == []
    (line,) = compare_logs(one, log(tmp_path / "changed", changed))
    assert "differs from step 3 on: loss 0.333" in line
    assert compare_logs(one, log(tmp_path / "short", rows[:3])) == ["the log has 4 steps here, 3 there"]


def test_saved_arrays_are_compared_by_name(tmp_path: Path) -> None:
    w = floats(0, 1, 2, 3)
    tree = {"w": w, "deep": {"b": np.zeros((), np.int32)}}
    save_weights(tmp_path / "one", tree)
    save_weights(tmp_path / "same", tree)
    save_weights(tmp_path / "other", tree | {"w": w + floats(0, 0, 0, 1e-6)})
    assert list(read_arrays(tmp_path / "one")) == ["['deep']['b']", "['w']"]
    assert compare_arrays(tmp_path / "one", tmp_path / "same") == []
    assert compare_arrays(tmp_path / "one", tmp_path / "other") == ["one: ['w'] differs"]
    assert compare_arrays(tmp_path / "one", tmp_path / "none") == [f"{tmp_path / 'none'}: missing"]


def test_a_runs_own_path_does_not_count_in_its_lists(tmp_path: Path) -> None:
    for name in ("one", "two"):
        stage = tmp_path / name / "stage"
        stage.mkdir(parents=True)
        row = json.dumps({"store": f"{tmp_path / name}/tokens", "record": 3})
        (stage / "quarantine.jsonl").write_text(f"{row}\n{row[:9]}\n{row}\n")
    one, two = (json_lines(tmp_path / name / "stage", "quarantine.jsonl") for name in ("one", "two"))
    assert one == two and len(one) == 1


def test_stages_differ_where_their_last_checkpoint_does(tmp_path: Path) -> None:
    loop = LoopConfig(steps=4, batch_size=2, log_every=100, checkpoint_every=2, sharding="jit")
    for name in ("one", "same"):
        save_weights(tmp_path / name / "weights", train(loop, tmp_path / name).weights)
    assert compare_stages(tmp_path / "one", tmp_path / "same") == []
    other = tmp_path / "other"
    shutil.copytree(tmp_path / "one", other)
    shutil.rmtree(other / "checkpoints" / "4")
    assert compare_stages(tmp_path / "one", other) == ["the newest checkpoint is of step 4 here, of 2 there"]
    (other / "checkpoints" / "2").rename(other / "checkpoints" / "4")
    differences = compare_stages(tmp_path / "one", other)
    assert any("'params'" in line for line in differences)
    assert any(line.startswith("the data position is") for line in differences)
