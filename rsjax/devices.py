"""Computes one batch on all of this process's devices: parameters on each, the batch's rows divided among them."""

import platform
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

Tree = TypeVar("Tree")  # a tree of arrays

_ROWS = "rows"


def on_cpu() -> bool:
    """Returns whether this process computes on a CPU. For the size of passes; a program's platform decides its code."""
    return jax.default_backend() == "cpu"


def device_name() -> str:
    """Returns the kind of this process's first device; of a CPU, which jax calls "cpu", the processor's name."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        return device.device_kind
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def replicate(params: Tree) -> Tree:
    """Puts parameters on every device of this process; with one device, returns them as they are."""
    devices = jax.local_devices()
    if len(devices) == 1:
        return params
    mesh = Mesh(np.array(devices), (_ROWS,), axis_types=(AxisType.Auto,))
    return jax.device_put(params, NamedSharding(mesh, P()))


def divide(batch: Tree, params: Any) -> Tree:
    """Puts a batch where its parameters are: rows divided among their devices if they can be, else all rows on each.

    If :func:`replicate` did not place the parameters on several devices, the batch is returned as it is.
    """
    place = getattr(next(iter(jax.tree.leaves(params)), None), "sharding", None)
    if not isinstance(place, NamedSharding) or place.mesh.axis_names != (_ROWS,):
        return batch

    def put(x: Any) -> Any:
        return jax.device_put(x, NamedSharding(place.mesh, P() if np.shape(x)[0] % place.mesh.size else P(_ROWS)))

    return jax.tree.map(put, batch)


def map_rows(run: Callable[[Any, Any], Any], params: Any, batch: Any, mesh: Mesh | None, count: Any = None) -> Any:
    """Returns the results of ``run(params, row)`` for all rows of a batch; each device runs its own rows one by one.

    Args:
        mesh: of a batch that is divided among devices, from :func:`mesh_of`; None: of any other.
        count: rows of an array on one device that are run, and may be traced; the results of others are 0. None: all.
    """

    def on_device(params: Any, rows: Any) -> Any:
        if count is None:
            return jax.lax.map(partial(run, params), rows)
        of_one = jax.eval_shape(run, params, rows[0])
        empty = jnp.zeros((len(rows), *of_one.shape), of_one.dtype)
        return jax.lax.fori_loop(0, count, lambda i, out: out.at[i].set(run(params, rows[i])), empty)

    if mesh is None:
        return on_device(params, batch)
    return jax.shard_map(on_device, mesh=mesh, in_specs=(P(), P(_ROWS)), out_specs=P(_ROWS), check_vma=False)(
        params, batch
    )


def mesh_of(batch: Any) -> Mesh | None:
    """Returns the mesh of an array whose rows :func:`divide` divided among devices; None for any other array."""
    place = getattr(batch, "sharding", None)
    if isinstance(place, NamedSharding) and isinstance(place.mesh, Mesh) and place.spec == P(_ROWS):
        return place.mesh
    return None
