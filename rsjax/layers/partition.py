"""Keeps a program that is sharded over clips divided by clips.

Compilers cannot look into kernels: without :func:`each_own_clips` they gather a kernel's operands on every device, and
run it there whole. And where a mesh splits the parameters, they would split activations in the same way and exchange
those in each layer, which are far larger; with :func:`gathered` each device gathers the parameters instead.
"""

from collections.abc import Callable
from functools import partial
from math import prod
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.experimental.custom_partitioning import custom_partitioning
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

FSDP = "fsdp"  # the axis of a mesh that splits the parameters


def gathered(params: Any) -> Any:
    """Returns parameters that are whole on every device, while they are used; without a mesh, as they are."""
    if FSDP not in jax.sharding.get_abstract_mesh().axis_names:
        return params
    return jax.tree.map(lambda x: jax.lax.with_sharding_constraint(x, PartitionSpec()), params)


def gathers(block: type[nn.Module]) -> Any:
    """Returns a class of blocks each of which gathers its parameters when it runs; those of other blocks stay split."""
    return nn.map_variables(block, "params", trans_in_fn=gathered, init=True)


def devices_are_known() -> bool:
    """Returns whether a program being traced is for one device, or for a mesh that is set."""
    return jax.device_count() == 1 or bool(jax.sharding.get_abstract_mesh().axis_names)


def each_own_clips(run: Callable[..., Any], settings: int, shared: int = 0) -> Callable[..., Any]:
    """Returns a function that runs on each device with the clips it holds.

    It finds out how clips are sharded by itself. On TPUs this does not work yet (github.com/jax-ml/jax/issues/38196):
    there, a program for several devices must be traced under ``jax.set_mesh(mesh)``, over all of whose axes clips are
    divided, or use no kernel (:func:`devices_are_known`).

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

    return _folding(divided, settings, shared)


def _folding(run: Callable[..., Any], settings: int, shared: int) -> Callable[..., Any]:
    """Returns a function that ``vmap`` runs once, with its axis folded into that over clips."""

    def folding(*arguments: Any) -> Any:
        values = arguments[:settings]
        arrays = arguments[settings:]

        @jax.custom_batching.custom_vmap
        def call(*arrays: Any) -> Any:
            return run(*values, *arrays)

        @call.def_vmap
        def batched(size: int, are_batched: Any, *arrays: Any) -> tuple[Any, Any]:
            of_clips = len(arrays) - shared
            if any(are_batched[of_clips:]):
                raise NotImplementedError("parameters of a kernel cannot be mapped over; map over clips alone")
            folded = [
                (x if is_batched else jnp.broadcast_to(x, (size, *x.shape))).reshape(-1, *x.shape[is_batched + 1 :])
                for x, is_batched in zip(arrays[:of_clips], are_batched, strict=False)
            ]
            out = call(*folded, *arrays[of_clips:])
            return jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), out), jax.tree.map(lambda _: True, out)

        return call(*arrays)

    return folding


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
