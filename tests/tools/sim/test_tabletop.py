"""The tabletop: its expert does what the instruction says, and demonstrations have the keys of openpi's LIBERO data."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from rsjax.tools.export.demonstrations import DemonstrationOptions, export_libero
from rsjax.tools.sim.tabletop import APART, OBJECTS, STEPS, TabletopSim, demonstration, draw_manner, scattered


@pytest.fixture(scope="module")
def table(gl: str) -> Iterator[TabletopSim]:
    with TabletopSim(image_size=32) as sim:
        yield sim


def test_the_expert_puts_the_named_object_in_the_basket(table: TabletopSim) -> None:
    successes = []
    for seed, task in enumerate(OBJECTS):
        table.task = task
        table.reset(seed)
        assert not table.success
        rng = np.random.default_rng(seed)
        act = demonstration(rng, task).expert(rng).act
        for _ in range(STEPS):
            table.step(act(table.state))
            if table.success:
                break
        successes.append(table.success)
        table.task = next(name for name in OBJECTS if name != task)
        assert not table.success, "another instruction is not fulfilled by it"
    assert sum(successes) >= 3


def test_a_start_depends_on_its_seed_alone(table: TabletopSim) -> None:
    table.reset(5)
    first = table.body_poses()[0]
    picture = table.render().rgb
    table.reset(6)
    assert np.abs(table.body_poses()[0] - first).max() > 0.02
    table.reset(5)
    np.testing.assert_array_equal(table.body_poses()[0], first)
    np.testing.assert_array_equal(table.render().rgb, picture)
    assert table.robot_state.shape == (8,)
    assert table.robot_state[6] > 0 > table.robot_state[7], "the fingers' joints, as robosuite signs them"


def test_an_object_at_rest_has_no_height(table: TabletopSim) -> None:
    table.reset(3)
    for task in OBJECTS:
        table.task = task
        assert abs(table.object_height) < 1e-9
    table.step(np.zeros(7))
    assert abs(table.object_height) < 1e-3


def test_objects_keep_apart_and_modes_name_their_object() -> None:
    rng = np.random.default_rng(0)
    places = scattered(rng, 4)
    distances = np.linalg.norm(places[:, None] - places, axis=-1)
    assert distances[~np.eye(4, dtype=bool)].min() >= APART
    for _ in range(50):
        manner = draw_manner(rng, 2)
        assert (manner.target == 2) == (manner.mode != "wrong")


def test_demonstrations_have_the_keys_that_openpi_reads(gl: str, tmp_path: Path) -> None:
    options = DemonstrationOptions(demos=1, size=32)
    info = export_libero(tmp_path / "libero", options)
    features = info["features"]
    assert features["image"]["shape"] == features["wrist_image"]["shape"] == [32, 32, 3]
    assert features["state"]["shape"] == [8] and features["actions"]["shape"] == [7]
    assert info["fps"] == 20 and info["codebase_version"] == "v2.1" and info["robot_type"] == "panda"
    table = pq.read_table(next((tmp_path / "libero" / "data").rglob("*.parquet")))
    actions = np.array(table["actions"].to_pylist())
    states = np.array(table["state"].to_pylist())
    assert len(actions) == info["total_frames"] and np.abs(actions).max() <= 1
    assert set(np.unique(actions[:, 6])) == {-1.0, 1.0}
    moved = np.diff(states[:, :3], axis=0).sum(0)
    np.testing.assert_allclose(0.015 * actions[:-1, :3].sum(0), moved, atol=0.06)  # the arm lags behind its goal
    videos = sorted(path.parent.name for path in (tmp_path / "libero").rglob("*.mp4"))
    assert videos == ["image", "wrist_image"]
    task = json.loads((tmp_path / "libero" / "meta" / "tasks.jsonl").read_text().splitlines()[0])
    assert task["task"] == "pick up the red cube and place it in the basket"
