"""The one door to what differs between platforms: each function is lowered to the implementation for its platform.

The platform is the one that a program is lowered for. Models do not ask for it. In a process that has CPUs alone only
their implementation is traced, unless :func:`for_all_platforms` says that the program is lowered for another platform.

Axes: N rows, frames or sequences, S cells, h heads, e head width; B images, T frames, h×w cells, C and D channels,
i×j a kernel.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax.extend.backend import backends
from jaxtyping import Array, Float

from rsjax import runtime
from rsjax.layers import accelerator, attention
from rsjax.layers.attention import KeyValues, attend, attend_cached, unpacked
from rsjax.layers.cpu import convolution, frame_attention, winograd
from rsjax.layers.cpu import matmul as cpu_matmul
from rsjax.layers.cpu.cache import put_clip_by_clip
from rsjax.layers.gpu import attention as gpu
from rsjax.layers.gpu import cached_attention as gpu_cached
from rsjax.layers.gpu import feed_forward as gpu_feed_forward
from rsjax.layers.gpu import mlp as gpu_mlp
from rsjax.layers.gpu import norm_linear as gpu_norm_linear
from rsjax.layers.parameters import Linear, Norm
from rsjax.layers.partition import devices_are_known
from rsjax.layers.tpu import attention as tpu
from rsjax.layers.unstacked_params import block_part

_for_all_platforms = jax.make_user_context(default_value=False)  # part of the keys of jax's caches of traced programs


def for_all_platforms() -> AbstractContextManager[Any]:
    """Returns a context in which programs are traced for all platforms, to be lowered for a GPU or TPU without one."""
    context: AbstractContextManager[Any] = _for_all_platforms(True)
    return context


def platform_dependent(*operands: Any, default: Callable[..., Any], **branches: Callable[..., Any]) -> Any:
    """Returns what ``jax.lax.platform_dependent`` does, which traces all branches, each time with all that is in it.

    Where branches lie in branches, this takes most of the time before a first step. So a process that can run programs
    on CPUs alone traces their branch alone.
    """
    if set(backends()) == {"cpu"} and not _for_all_platforms.value:
        return branches.get("cpu", default)(*operands)
    return jax.lax.platform_dependent(*operands, default=default, **branches)


def by_platform(cpu: Callable[..., Any], accelerator: Callable[..., Any], *operands: Any) -> Any:
    """Returns ``cpu(*operands)`` in a program for a CPU and ``accelerator(*operands)`` in one for a GPU or TPU."""
    return platform_dependent(*operands, cpu=cpu, default=accelerator)


def where_launches_take_long(few: Callable[[], Any], other: Callable[[], Any]) -> Any:
    """Returns ``few()`` in a program for an NVIDIA GPU, where small kernels take less than their launches."""
    return platform_dependent(cuda=few, default=other)


def in_feature_dtype(dtype: str, run: Callable[[str], Any]) -> Any:
    """Returns ``run(dtype)``; in a program for a CPU ``run("float32")``, since features in bf16 are slower there."""
    if dtype == "float32":
        return run(dtype)
    return by_platform(partial(run, "float32"), partial(run, dtype))


def known_after(x: Float[Array, "..."], number: Any) -> Any:
    """Returns a whole number that, if it is traced, a program for a CPU knows only when it has computed x.

    A cache that is written at this place is then written in place, after all that x depends on has read it. XLA would
    order neither by itself, nor by a barrier, and copy the cache.
    """
    if not isinstance(number, Array):
        return number

    def late(x: Array, number: Array) -> Array:
        # 0; for NaN 1, which does not matter to that clip, but moves the place of all other clips of the batch too.
        return number + jnp.isnan(x.reshape(-1)[0])

    return by_platform(late, lambda x, number: number, x, number)


def put_frames(cache: Any, new: Any, start: Any, ring: bool) -> Any:
    """Returns a cache into which new frames from ``start`` on are written; both have a leading axis over blocks.

    Args:
        cache: a tree of :class:`KeyValues`, or :func:`rsjax.layers.unstacked_params.unstack_params` of it.
        new: a tree of the same structure with the new frames.
        ring: whether positions beyond the number of slots wrap around.
    """
    if isinstance(cache, list):
        return [put_frames(old, block_part(new, i), start, ring) for i, old in enumerate(cache)]
    each = jax.custom_batching.custom_vmap(partial(attention.put_frames, ring=ring))

    @each.def_vmap
    def _(clips: int, batched: list[bool], *operands: Array) -> tuple[Array, bool]:
        mapped = jax.vmap(partial(attention.put_frames, ring=ring))
        x = [
            y if of_clips else jnp.broadcast_to(y, (clips, *y.shape))
            for y, of_clips in zip(operands, batched, strict=True)
        ]
        return by_platform(partial(put_clip_by_clip, ring=ring), mapped, *x), True

    def put(old: Array, fresh: Array) -> Array:
        if not isinstance(start, Array):
            return attention.put_frames(old, fresh.astype(old.dtype), start, ring)
        written: Array = each(old, fresh.astype(old.dtype), start)
        return written

    return jax.tree.map(put, cache, new)


def attend_in_clip(
    qkv: Float[Array, "B T S 3 h e"], over: Literal["cells", "frames"], bf16: bool
) -> Float[Array, "B T S h e"]:
    """Returns softmax(q·kᵀ/√e)·v among the cells of each frame, or of each cell over the frames up to its own.

    Args:
        qkv: queries, keys and values as their projection returns them; GPUs and TPUs read them in place.
        bf16: whether products may round their operands to bf16.
    """

    def plain(qkv: Array) -> Array:
        q, k, v = unpacked(qkv)
        if over == "cells":
            return attend_cells(q, k, v, bf16)
        q, k, v = (x.swapaxes(1, 2) for x in (q, k, v))
        return attend(q, k, v, jnp.tri(q.shape[-3], dtype=bool)).swapaxes(1, 2)

    kernels = {}
    if qkv.dtype == jnp.bfloat16 and gpu.fits(qkv.shape, over):
        kernels["cuda"] = partial(gpu.attend, over=over)
    if qkv.dtype == jnp.bfloat16 and tpu.fits(qkv.shape, over) and devices_are_known():
        kernels["tpu"] = partial(tpu.attend, over=over)
    return platform_dependent(qkv, default=plain, **kernels)


def attend_over_cache(
    qkv: Float[Array, "B T S 3 h e"], cache: KeyValues, start: Any, window: int
) -> Float[Array, "B T S h e"]:
    """Returns :func:`rsjax.layers.attention.attend_cached`; GPUs do it by one kernel if all is bf16 and fits.

    The kernel has no gradient.
    """
    plain = partial(attend_cached, window=window)
    are_bf16 = qkv.dtype == cache.k.dtype == jnp.bfloat16
    if not are_bf16 or not gpu_cached.fits(qkv.shape, cache.k.shape[-2]):
        return plain(qkv, cache, start)

    def kernel(qkv: Array, cache: KeyValues, start: Any) -> Array:
        return gpu_cached.attend(qkv, cache.k, cache.v, start, window)

    return platform_dependent(qkv, cache, start, cuda=kernel, default=plain)


def mlp(
    x: Float[Array, "B T S C"],
    norm: Norm | None,
    fc1: Linear,
    fc2: Linear,
    layers: Callable[..., Float[Array, "B T S C"]],
) -> Float[Array, "B T S C"]:
    """Returns ``layers(x, norm, fc1, fc2)``, x + fc2(gelu(fc1(norm(x)))).

    GPUs do it by one kernel a pass if x is bf16 and fits.
    """
    if x.dtype != jnp.bfloat16 or not gpu_mlp.fits(x.shape, fc1[0].shape[1]):
        return layers(x, norm, fc1, fc2)
    return platform_dependent(x, norm, fc1, fc2, cuda=gpu_mlp.mlp, default=layers)


def feed_forward(
    x: Float[Array, "B T S C"],
    fc1: Linear,
    fc2: Linear,
    layers: Callable[..., Float[Array, "B T S C"]],
) -> Float[Array, "B T S C"]:
    """Returns ``layers(x, fc1, fc2)``, fc2(gelu(fc1(x))).

    GPUs keep what lies around the GELU on the chip if x is bf16 and fits.
    """
    if x.dtype != jnp.bfloat16 or not gpu_feed_forward.fits(x.shape, fc1[0].shape[1]):
        return layers(x, fc1, fc2)
    return platform_dependent(x, fc1, fc2, cuda=gpu_feed_forward.feed_forward, default=layers)


def norm_linear(
    x: Float[Array, "B T S C"],
    norm: Norm,
    kernel: Float[Array, "C D"],
    layers: Callable[..., Float[Array, "B T S D"]],
) -> Float[Array, "B T S D"]:
    """Returns ``layers(x, norm, kernel)``, layer_norm(x)·kernel; GPUs do it by one kernel if x is bf16 and fits.

    A program with a gradient runs ``layers`` instead, forward too: the kernel is for generation.
    """
    if x.dtype != jnp.bfloat16 or not gpu_norm_linear.fits(x.shape, kernel.shape[1]):
        return layers(x, norm, kernel)

    @jax.custom_vjp
    def run(*operands: Any) -> Any:
        return platform_dependent(*operands, cuda=gpu_norm_linear.norm_linear, default=layers)

    run.defvjp(lambda *operands: jax.vjp(layers, *operands), lambda pull, cotangent: pull(cotangent))
    out: Array = run(x, norm, kernel)
    return out


def linear(
    x: Float[Array, "N K"], w: Float[Array, "K M"], bias: Float[Array, " M"] | None = None
) -> Float[Array, "N M"]:
    """Returns x·w + bias in the number format of x: operands rounded to bf16, products added up in float32.

    CPUs without bf16 units multiply in float32, where this is as fast.
    """
    return by_platform(cpu_matmul.linear, accelerator.linear, x, w, bias)


def attend_cells(
    q: Float[Array, "*N S h e"],
    k: Float[Array, "*N S h e"],
    v: Float[Array, "*N S h e"],
    bf16: bool,
    causal: bool = False,
) -> Float[Array, "*N S h e"]:
    """Returns :func:`rsjax.layers.attention.attend` within each frame or sequence.

    Args:
        bf16: whether products may round their operands to bf16.
        causal: whether a query sees only its own key and those before it.
    """
    cells = q.shape[-3]
    frames = [x.reshape(-1, *x.shape[-3:]) for x in (q, k, v)]
    plain = partial(attend, mask=jnp.tri(cells, dtype=bool) if causal else None)
    if not bf16:
        return plain(*frames).reshape(q.shape)

    def on_cpu(*frames: Array) -> Array:
        if cells < frame_attention.LARGE_FRAME:
            return plain(*frames)
        return frame_attention.attend_in_frames(*(x.astype(jnp.float32) for x in frames), causal).astype(q.dtype)

    return by_platform(on_cpu, partial(accelerator.attend, causal=causal), *frames).reshape(q.shape)


def convolve(
    x: Float[Array, "B h w C"],
    kernel: Float[Array, "i j C D"],
    window_strides: Sequence[int],
    padding: Any,
    transformed: Float[Array, "16 C D"] | None = None,
    **settings: Any,  # axes must be in the order of flax's layers
) -> Float[Array, "B h w D"]:
    """Convolves as ``jax.lax.conv_general_dilated`` does, with operands rounded to bf16 where this is faster.

    On an accelerator the result is rounded to bf16 too, as in the layers of other libraries.

    Args:
        transformed: the kernel by :func:`with_transformed_kernels`, of a convolution that keeps the image's size; CPUs
            read it in place of the kernel where that is faster. It has no gradient for the kernel.
    """
    settings |= {"window_strides": window_strides, "padding": padding}

    def on_cpu(x: Array, kernel: Array) -> Array:
        if transformed is not None and winograd.takes(x, transformed):
            return winograd.convolve_transformed(x, transformed)
        return convolution.convolve(x, kernel, **settings)

    return by_platform(on_cpu, partial(accelerator.convolve, **settings), x, kernel)


def with_transformed_kernels(params: Any) -> Any:
    """Returns the parameters with "transformed" beside each 3×3 kernel that CPUs can convolve with faster so.

    The convolutions must have stride 1 and round their operands to bf16.
    """
    if not isinstance(params, dict):
        return params
    if "kernel" not in params:
        return {name: with_transformed_kernels(inner) for name, inner in params.items()}
    if runtime.has_bf16_units() and winograd.transforms(params["kernel"]):
        return params | {"transformed": winograd.transformed_kernel(params["kernel"])}
    return params


def convolve_video(
    frames: Float[Array, "B T h w C"], kernel: Float[Array, "3 3 3 C D"], bf16: bool
) -> Float[Array, "B T-2 h w D"]:
    """Returns the 3-D convolution, padded with zeros in space only.

    Args:
        bf16: whether operands are rounded to bf16, as in :func:`convolve`.
    """
    on_cpu = partial(convolution.convolve_video, bf16=bf16)
    return by_platform(on_cpu, partial(accelerator.convolve_video, bf16=bf16), frames, kernel)
