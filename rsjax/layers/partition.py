"""Divides kernels, which compilers cannot look into, among devices by clips.

Without this, a program that is sharded over clips gathers a kernel's operands on every device and runs it there whole.
"""

from collections.abc import Callable
from functools import partial
from math import prod
from typing import Any

import jax
from jax.experimental.custom_partitioning import custom_partitioning
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec


def each_own_clips(run: Callable[..., Any], settings: int) -> Callable[..., Any]:
    """Returns a function that runs on each device with the clips it holds.

    It finds out how clips are sharded by itself. On TPUs this does not work yet (github.com/jax-ml/jax/issues/38196):
    there, a program for several devices must be traced under ``jax.set_mesh(mesh)``, over all of whose axes clips are
    divided.

    Args:
        run: takes some settings and then arrays, and returns arrays, all with a leading axis over clips; what it does
            to a clip depends on no other clip.
        settings: how many; they are hashable.
    """
    on_any_devices = _as_sharded(run, settings)

    def divided(*arguments: Any) -> Any:
        axes = _divisible_axes()
        devices = prod(axes.values())
        clips = len(arguments[settings])
        if devices == 1 or clips % devices != 0:
            return on_any_devices(*arguments)
        spec = PartitionSpec(tuple(axes))
        own = partial(run, *arguments[:settings])
        on_mesh = jax.shard_map(own, in_specs=spec, out_specs=spec, axis_names=set(axes), check_vma=False)
        return on_mesh(*arguments[settings:])

    return divided


def _divisible_axes() -> dict[str, int]:
    """Returns the sizes of the axes of the mesh that is set."""
    mesh = jax.sharding.get_abstract_mesh()
    kinds = zip(mesh.axis_names, mesh.axis_types, strict=True)
    return {name: mesh.shape[name] for name, kind in kinds if kind == AxisType.Auto}


def _as_sharded(run: Callable[..., Any], settings: int) -> Callable[..., Any]:
    whole = custom_partitioning(run, static_argnums=tuple(range(settings)))

    def partition(*arguments: Any) -> tuple[Mesh, Callable[..., Any], Any, Any]:
        *values, mesh, operands, results = arguments
        clips = NamedSharding(mesh, PartitionSpec(*operands[0].sharding.spec[:1]))
        shardings = (jax.tree.map(lambda _: clips, arrays) for arrays in (results, operands))
        return mesh, partial(run, *values), *shardings

    def rule(*arguments: Any) -> tuple[str, dict[str, Any]]:
        *_, operands, results = arguments
        whole_axes: list[str] = []

        def axes(array: Any) -> str:
            names = [f"x{len(whole_axes) + i}" for i in range(1, array.rank)]
            whole_axes.extend(names)
            return " ".join(["clips", *names])

        sides = (", ".join([axes(array) for array in arrays]) for arrays in (operands, results))
        return " -> ".join(sides), {"need_replication_factors": tuple(whole_axes)}

    whole.def_partition(partition, sharding_rule=rule)
    return whole
