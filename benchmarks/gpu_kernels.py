"""Times the kernels of ``rsjax/layers/gpu`` beside XLA's own programs of the same layers, on the GPU of this machine.

``python -m benchmarks.gpu_kernels`` prints a line for each kernel, forward alone and with its gradient.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from rsjax.layers.attention import KeyValues, attend_cached
from rsjax.layers.attention import attend as plain_attend
from rsjax.layers.dense import dense, normalised
from rsjax.layers.gelu import gelu
from rsjax.layers.gpu import attention, cached_attention, feed_forward, mlp, norm_linear
from rsjax.tools.bench.timing import median_seconds

CALLS = 10  # in a measurement, to hide the launches
BUDGET = 1.0  # seconds of a measurement


@dataclass(frozen=True)
class Case:
    """A layer at a shape.

    Attributes:
        operands: the first of them is the features x.
        ours: the kernel.
        plain: what XLA compiles.
        has_gradient: whether the kernel has a gradient of its own.
    """

    name: str
    operands: tuple[Any, ...]
    ours: Callable[..., Any]
    plain: Callable[..., Any]
    has_gradient: bool = True


def main() -> None:
    """Prints the times."""
    if jax.default_backend() != "gpu":
        raise SystemExit("error: there is no GPU here")
    print(f"{'layer':44} {'ours, ms':>10} {'XLA, ms':>10}   with the gradient: ours, XLA")
    for case in cases():
        forward = [milliseconds(run, case.operands) for run in (case.ours, case.plain)]
        line = f"{case.name:44} {forward[0]:10.3f} {forward[1]:10.3f}"
        if case.has_gradient:
            both = [milliseconds(with_gradient(run), case.operands) for run in (case.ours, case.plain)]
            line += f"   {both[0]:10.3f} {both[1]:10.3f}"
        print(line, flush=True)


def milliseconds(run: Callable[..., Any], operands: tuple[Any, ...]) -> float:
    """Returns the median time of a call."""
    compiled = jax.jit(run)
    return 1e3 * median_seconds(lambda: [compiled(*operands) for _ in range(CALLS)], BUDGET) / CALLS


def with_gradient(run: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a function that computes the layer and the gradients of all its operands."""

    def both(*operands: Any) -> Any:
        out, pull = jax.vjp(run, *operands)
        return out, pull(out)

    return both


def cases() -> list[Case]:
    """Returns the layers of a training step of eight clips, and of a generated frame."""
    found = [_mlp(8, 256), _mlp(8, 128), _feed_forward(8, 512), _feed_forward(4, 1024)]
    found += [_attention(8, 8, 32, "cells"), _attention(8, 8, 32, "frames")]
    found += [_attention(4, 16, 64, "cells"), _attention(4, 16, 64, "frames")]

    def plain_norm(x: Any, norm: Any, kernel: Any) -> Any:
        return dense(normalised(x, norm), kernel, None, True)

    def over_cache(qkv: Any, k: Any, v: Any) -> Any:
        return cached_attention.attend(qkv, k, v, 14, 16)

    def plain_over_cache(qkv: Any, k: Any, v: Any) -> Any:
        return attend_cached(qkv, KeyValues(k, v), 14, 16)

    one = _features(8, 1, 256), (jnp.ones(256), jnp.zeros(256)), _normal(1, 256, 768, scale=1 / 16)
    found.append(Case("norm and qkv of a frame, 8 clips", one, norm_linear.norm_linear, plain_norm, False))
    cache = (_normal(number, 8, 256, 8, 16, 32, dtype=jnp.bfloat16) for number in (1, 2))
    frame = _normal(0, 8, 1, 256, 3, 8, 32, dtype=jnp.bfloat16), *cache
    found.append(Case("attention over the cache, 8 clips", frame, over_cache, plain_over_cache, False))
    return found


def _normal(number: int, *shape: int, dtype: Any = jnp.float32, scale: float = 1.0) -> jax.Array:
    return (scale * jax.random.normal(jax.random.key(number), shape)).astype(dtype)


def _two_linear(width: int) -> tuple[Any, Any]:
    hidden = 4 * width
    fc1 = _normal(1, width, hidden, scale=width**-0.5), _normal(2, hidden)
    return fc1, (_normal(3, hidden, width, scale=hidden**-0.5), _normal(4, width))


def _features(clips: int, frames: int, width: int) -> jax.Array:
    return _normal(0, clips, frames, 256, width, dtype=jnp.bfloat16)


def _mlp(clips: int, width: int) -> Case:
    def plain(x: Any, norm: Any, fc1: Any, fc2: Any) -> Any:
        return x + dense(gelu(dense(normalised(x, norm), fc1[0], fc1[1], True)), fc2[0], fc2[1], True)

    norm = jnp.ones(width), jnp.zeros(width)
    operands = _features(clips, 16, width), norm, *_two_linear(width)
    return Case(f"MLP of width {width}, {clips} clips", operands, mlp.mlp, plain)


def _feed_forward(clips: int, width: int) -> Case:
    def plain(x: Any, fc1: Any, fc2: Any) -> Any:
        return dense(gelu(dense(x, fc1[0], fc1[1], True)), fc2[0], fc2[1], True)

    operands = _features(clips, 16, width), *_two_linear(width)
    return Case(f"MLP of width {width}, {clips} clips", operands, feed_forward.feed_forward, plain)


def _attention(clips: int, heads: int, width: int, over: Any) -> Case:
    def plain(qkv: Any) -> Any:
        q, k, v = (qkv[:, :, :, i] for i in range(3))
        if over == "cells":
            return plain_attend(q, k, v, None)
        mask = jnp.tri(q.shape[1], dtype=bool)
        return plain_attend(q.swapaxes(1, 2), k.swapaxes(1, 2), v.swapaxes(1, 2), mask).swapaxes(1, 2)

    qkv = _normal(0, clips, 16, 256, 3, heads, width, dtype=jnp.bfloat16)
    name = f"attention over {over}, {heads} heads of {width}, {clips} clips"
    return Case(name, (qkv,), partial(attention.attend, over=over), plain)


if __name__ == "__main__":
    main()
