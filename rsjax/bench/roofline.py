"""The roofline of a training step: the time of each kind of operation beside the least that this machine allows.

The least time is that of its matrix products at the measured ceiling, or of its reads and writes at the measured
bandwidth, whichever is longer: every operand is read once and every result written once, in float32 (Williams et al.
2009). So it is the limit of a program that runs the operations one after another, as XLA does on a CPU; only fusing
them across these borders, or operands that fit the processor's caches, go below.

Axes: R rows (clips · frames · cells), C width.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax

from rsjax.bench.timing import median_seconds
from rsjax.config import Config
from rsjax.models.base import create_model
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.attention import Dense, attend, attend_cells, layer_norm
from rsjax.models.roboscape.gelu import gelu
from rsjax.models.roboscape.model import RoboScape
from rsjax.training.state import make_optimizer

STREAM = 2**24  # numbers in each of the arrays by which the bandwidth is measured: 64 MiB, more than a cache holds
FLOAT = 4  # bytes


@dataclass(frozen=True)
class Operation:
    """An operation of the forward pass.

    Attributes:
        name: of it, for all places with operands of these shapes.
        times: places in a step.
        run: from operands to the result; a module's parameters are operands too.
        shapes: of the operands.
        flops: of its matrix products, forward; its gradient has twice as many.
        passes_on: whether its operands' gradients are the result's, so that the gradient moves nothing.
    """

    name: str
    times: int
    run: Callable[..., Any]
    shapes: tuple[tuple[int, ...], ...]
    flops: float = 0.0
    passes_on: bool = False


def roofline(config: Config, batch: int, ceiling: float, budget: float) -> dict[str, Any]:
    """Measures each kind of operation of a training step alone, forward and gradient.

    Args:
        ceiling: operations a second of matrix products.
        budget: seconds per quantity.

    Returns:
        For each operation seconds in a whole step, the least seconds, and the share of the second in the first; the
        sums; and the bandwidth. Empty for a family other than RoboScape and Genie.
    """
    model = create_model(config)
    if not isinstance(model, RoboScape):
        return {}
    speed = bandwidth(budget)
    numbers: dict[str, Any] = {"roofline_bandwidth_bytes_per_s": speed}
    rows = {each.name: _measure(each, ceiling, speed, budget) for each in operations(model.architecture, config, batch)}
    rows["optimizer"] = _optimizer(config, model, speed, budget)
    for name, (seconds, least) in rows.items():
        numbers |= {f"roofline_{name}_s": seconds, f"roofline_{name}_least_s": least}
        numbers[f"roofline_{name}_share"] = least / seconds
    total, least = (sum(row[place] for row in rows.values()) for place in (0, 1))
    return numbers | {"roofline_sum_s": total, "roofline_sum_least_s": least, "roofline_sum_share": least / total}


def bandwidth(budget: float) -> float:
    """Returns bytes a second, read and written, of the sum of two large arrays."""
    x, y = jnp.ones(STREAM), jnp.ones(STREAM)
    add = jax.jit(jnp.add)
    return 3 * FLOAT * STREAM / median_seconds(lambda: add(x, y), budget)


def operations(arch: Architecture, config: Config, batch: int) -> tuple[Operation, ...]:
    """Returns the operations of a training step's forward pass without rematerialisation, embeddings excepted."""
    width, hidden, heads, frames = arch.width, arch.mlp_ratio * arch.width, arch.heads, config.clips.frames
    cells, blocks = arch.grid**2, arch.blocks * len(arch.branches)
    rows, bf16 = batch * frames * cells, arch.compute_dtype == "bfloat16"
    norms = blocks * ((4 if arch.qk_norm else 2) + arch.temporal_norm) + arch.final_norm * len(arch.branches)
    joint = arch.blocks if arch.use_depth else 0  # depth → RGB

    def product(name: str, times: int, inputs: int, outputs: int) -> Operation:
        layer = Dense(outputs, bf16, use_bias=False)
        run = lambda x, kernel: layer.apply({"params": {"kernel": kernel}}, x)  # noqa: E731
        return Operation(name, times, run, ((rows, inputs), (inputs, outputs)), 2.0 * rows * inputs * outputs)

    def norm(x: Any, scale: Any, bias: Any) -> Any:
        return layer_norm(None).apply({"params": {"scale": scale, "bias": bias}}, x)

    def attention(name: str, run: Any, groups: int, keys: int) -> Operation:
        shape = (batch, groups, keys, heads, width // heads)
        return Operation(name, blocks, run, (shape,) * 3, 4.0 * rows * keys * width)

    vocabulary = (rows, arch.vocabularies, arch.vocabulary_size)
    return (
        product("qkv", 2 * blocks, width, 3 * width),
        product("projection", 2 * blocks + joint, width, width),
        product("mlp_in", blocks, width, hidden),
        product("mlp_out", blocks, hidden, width),
        product("head", len(arch.branches), width, arch.vocabularies * arch.vocabulary_size),
        attention("attention_in_frames", partial(attend_cells, bf16=bf16), frames, cells),
        attention("attention_over_time", partial(_causal, frames), cells, frames),
        Operation("gelu", blocks, gelu, ((rows, hidden),)),
        Operation("norm", norms, norm, ((rows, width), (width,), (width,))),
        Operation("residual_sum", 3 * blocks + joint, jnp.add, ((rows, width),) * 2, passes_on=True),
        Operation("loss", len(arch.branches), _cross_entropy, (vocabulary,)),
    )


def _causal(frames: int, q: Any, k: Any, v: Any) -> Any:
    return attend(q, k, v, jnp.tril(jnp.ones((frames, frames), bool)))


def _cross_entropy(logits: Any) -> Any:
    return optax.softmax_cross_entropy_with_integer_labels(logits, jnp.zeros(logits.shape[:-1], jnp.int32))


def _measure(operation: Operation, ceiling: float, speed: float, budget: float) -> tuple[float, float]:
    """Returns seconds and least seconds of an operation in a whole step."""
    keys = jax.random.split(jax.random.key(0), len(operation.shapes))
    operands = [jax.random.normal(key, shape) for key, shape in zip(keys, operation.shapes, strict=True)]

    @jax.jit
    def both(cotangent: Any, *operands: Any) -> Any:
        out, pull = jax.vjp(operation.run, *operands)
        return out, pull(cotangent)

    out = jax.eval_shape(operation.run, *operands)
    cotangent = jnp.ones(out.shape, out.dtype)
    seconds = median_seconds(lambda: both(cotangent, *operands), budget)
    read = sum(x.size for x in operands)
    # Forward: operands and result. Gradient: operands, the result's gradient, and the operands' gradients.
    moved = FLOAT * (read + out.size + (0 if operation.passes_on else 2 * read + out.size))
    return operation.times * seconds, operation.times * max(3 * operation.flops / ceiling, moved / speed)


def _optimizer(config: Config, model: RoboScape, speed: float, budget: float) -> tuple[float, float]:
    """Returns seconds and least seconds of a step of the optimizer; Muon's matrix products are not counted."""
    params = jax.jit(model.init)(jax.random.key(0))
    optimizer = make_optimizer(config.train)
    state = jax.jit(optimizer.init)(params)
    moments = sum(x.size for x in jax.tree.leaves(state) if x.ndim)

    @partial(jax.jit, donate_argnums=(0, 1))
    def update(params: Any, state: Any, gradients: Any) -> Any:
        updates, state = optimizer.update(gradients, state, params)
        return optax.apply_updates(params, updates), state

    def run() -> Any:
        nonlocal params, state
        params, state = update(params, state, gradients)
        return params

    gradients = jax.tree.map(jnp.ones_like, params)
    numbers = sum(x.size for x in jax.tree.leaves(gradients))
    return median_seconds(run, budget), FLOAT * (3 * numbers + 2 * moments) / speed
