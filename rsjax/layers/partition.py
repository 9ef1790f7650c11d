"""Divides kernels, which compilers cannot look into, among devices by clips.

Without this, a program that is sharded over clips gathers a kernel's operands on every device and runs it there whole.
"""

from collections.abc import Callable
from typing import Any

import jax
from jax.experimental.custom_partitioning import custom_partitioning
from jax.sharding import Mesh, NamedSharding, PartitionSpec


def each_own_clips(run: Callable[..., Any], settings: int) -> Callable[..., Any]:
    """Returns a function that runs on each device with the clips it holds.

    Args:
        run: takes some settings and then arrays, and returns arrays, all with a leading axis over clips; what it does
            to a clip depends on no other clip.
        settings: how many; they are hashable.
    """
    whole = custom_partitioning(run, static_argnums=tuple(range(settings)))

    def partition(*arguments: Any) -> tuple[Mesh, Callable[..., Any], Any, Any]:
        *values, mesh, operands, results = arguments
        clips = NamedSharding(mesh, PartitionSpec(*operands[0].sharding.spec[:1]))
        shardings = (jax.tree.map(lambda _: clips, arrays) for arrays in (results, operands))
        return mesh, lambda *own: run(*values, *own), *shardings

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
