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


def each_own_clips(run: Callable[..., Any], settings: int, shared: int = 0) -> Callable[..., Any]:
    """Returns a function that runs on each device with the clips it holds.

    It finds out how clips are sharded by itself. On TPUs this does not work yet (github.com/jax-ml/jax/issues/38196):
    there, a program for several devices must be traced under ``jax.set_mesh(mesh)``, over all of whose axes clips are
    divided.

    Args:
        run: takes settings, arrays with a leading axis over clips, and shared arrays, and returns arrays with a leading
            axis over clips; what it does to a clip depends on no other clip.
        settings: how many; they are hashable.
        shared: how many arrays, such as parameters.
    """
    on_any_devices = _as_sharded(run, settings, shared)

    def divided(*arguments: Any) -> Any:
        mesh = jax.sharding.get_abstract_mesh()  # the one that is set
        kinds = zip(mesh.axis_names, mesh.axis_types, strict=True)
        axes = {name: mesh.shape[name] for name, kind in kinds if kind == AxisType.Auto}
        devices = prod(axes.values())
        clips = len(arguments[settings])
        if devices == 1 or clips % devices != 0:
            return on_any_devices(*arguments)
        spec = PartitionSpec(tuple(axes))
        own = partial(run, *arguments[:settings])
        arrays = arguments[settings:]
        specs = (spec,) * (len(arrays) - shared) + (PartitionSpec(),) * shared
        return jax.shard_map(own, in_specs=specs, out_specs=spec, axis_names=set(axes), check_vma=False)(*arrays)

    return divided


def _as_sharded(run: Callable[..., Any], settings: int, shared: int) -> Callable[..., Any]:
    divided = custom_partitioning(run, static_argnums=tuple(range(settings)))

    def partition(*arguments: Any) -> tuple[Mesh, Callable[..., Any], Any, Any]:
        *values, mesh, operands, results = arguments
        clips = NamedSharding(mesh, PartitionSpec(*operands[0].sharding.spec[:1]))
        whole = NamedSharding(mesh, PartitionSpec())
        of_operands = (clips,) * (len(operands) - shared) + (whole,) * shared
        return mesh, partial(run, *values), jax.tree.map(lambda _: clips, results), of_operands

    def rule(*arguments: Any) -> tuple[str, dict[str, Any]]:
        *_, operands, results = arguments
        whole_axes: list[str] = []  # in the order of the rule, as it must be

        def axes(array: Any, over_clips: bool) -> str:
            split = ["clips"] * over_clips
            whole = [f"x{len(whole_axes) + i}" for i in range(array.rank - over_clips)]
            whole_axes.extend(whole)
            return " ".join(split + whole)

        kinds = [i < len(operands) - shared for i in range(len(operands))]
        taken = ", ".join(map(axes, operands, kinds))
        returned = ", ".join([axes(array, True) for array in results])
        return f"{taken} -> {returned}", {"need_replication_factors": tuple(whole_axes)}

    divided.def_partition(partition, sharding_rule=rule)
    return divided
