"""Checkpoints of two processes with two devices each; :mod:`tests.training.hosts` runs this in both."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from rsjax.training.checkpoint import Checkpoints, load_weights, save_weights


def state(step: int) -> dict[str, Any]:
    rng = np.random.default_rng(step)
    return {"cut": rng.random((8, 16), np.float32), "whole": rng.random(5, np.float32), "step": np.int32(step)}


def shardings(mesh: Mesh, cut: PartitionSpec) -> dict[str, NamedSharding]:
    whole = NamedSharding(mesh, PartitionSpec())
    return {"cut": NamedSharding(mesh, cut), "whole": whole, "step": whole}


def placed(step: int, where: dict[str, NamedSharding]) -> dict[str, Any]:
    return jax.tree.map(lambda x, at: jax.make_array_from_callback(x.shape, at, lambda i: x[i]), state(step), where)


def template(where: dict[str, Any]) -> dict[str, Any]:
    return jax.tree.map(lambda x, at: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=at), state(0), where)


def assert_state(restored: dict[str, Any], step: int, where: dict[str, Any]) -> None:
    for name, value in state(step).items():
        assert restored[name].sharding == where[name]
        for shard in restored[name].addressable_shards:
            np.testing.assert_array_equal(shard.data, value[shard.index])


def save_together(directory: Path) -> None:
    """Saves sharded states, damages the newest checkpoint, and restores the one before with other shardings."""
    me = jax.process_index()
    mesh = jax.make_mesh((2, 2), ("data", "fsdp"), axis_types=(AxisType.Auto,) * 2)
    cut = shardings(mesh, PartitionSpec("fsdp"))
    here = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    checkpoints = Checkpoints(directory)
    for step in (1, 2):
        checkpoints.save(step, placed(step, cut), {"next": step})
    checkpoints.save(3, jax.tree.map(jnp.asarray, state(3)), {"next": 3})  # each process has one of its own
    checkpoints.wait()
    if me == 0:
        (directory / "3" / "data" / "metadata").unlink()
    multihost_utils.sync_global_devices("damaged")
    other = shardings(mesh, PartitionSpec("data", "fsdp"))
    restored, data = checkpoints.restore(template(other))
    assert data == {"next": 2}
    assert_state(restored, 2, other)
    checkpoints.save(3, jax.tree.map(jnp.asarray, state(3)), {"next": 3})
    alone = dict.fromkeys(state(0), here)
    restored, data = checkpoints.restore(template(alone))
    assert data == {"next": 3}
    assert_state(restored, 3, alone)
    checkpoints.save(4, placed(4, cut), {"next": 4})
    checkpoints.close()
    if me == 0:
        save_weights(directory / "weights", jax.tree.map(jnp.asarray, state(9)))
        np.testing.assert_array_equal(load_weights(directory / "weights", template(alone))["cut"], state(9)["cut"])
    multihost_utils.sync_global_devices("saved")
    np.testing.assert_array_equal(load_weights(directory / "weights", template(alone))["cut"], state(9)["cut"])
