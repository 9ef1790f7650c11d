"""Rooflines: the time of each kind of operation, compared with the least time that this machine allows.

They cover a training step, the tokenizer's products for one image, and a pass of cached sampling.

The least time of an operation is that of its matrix products at the measured ceiling, or of its reads and writes at
the measured bandwidth, whichever is longer. Every operand is read once and every result is written once, in float32
(Williams et al. 2009). This limits a program that runs the operations one after another, as XLA does on a CPU. A
program can be faster only if it fuses operations, or if operands fit the processor's caches.

Axes: R rows (clips · frames · cells), C width.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.extend.core import jaxprs_in_params

from rsjax.config import Config, TokenizerConfig
from rsjax.layers.attention import attend
from rsjax.layers.dense import Dense, layer_norm
from rsjax.layers.gelu import gelu
from rsjax.layers.platform import attend_cells, convolve
from rsjax.models.base import create_model
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.flops import forward_flops
from rsjax.models.roboscape.model import RoboScape
from rsjax.models.roboscape.sample import apply_network, cache_slots, new_cache
from rsjax.models.roboscape.transformer import Cache, StackedCache
from rsjax.tokenizers.flops import products as count_products
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tools.bench import inputs
from rsjax.tools.bench.timing import median_seconds
from rsjax.trainable import Params
from rsjax.training.state import make_optimizer

STREAM = 2**24  # numbers in each array that measures the bandwidth: 64 MiB, more than a cache holds
FLOAT = 4  # bytes


@dataclass(frozen=True)
class Operation:
    """An operation of the forward pass.

    Attributes:
        name: its name, common to all places in a step where operands have these shapes.
        times: number of these places.
        run: maps operands to the result; a module's parameters are operands too.
        shapes: shapes of the operands.
        flops: floating-point operations of its forward matrix products; its gradient has twice as many.
        passes_on: whether the operands' gradients equal the result's gradient, so that the gradient moves no data.
    """

    name: str
    times: int
    run: Callable[..., Any]
    shapes: tuple[tuple[int, ...], ...]
    flops: float = 0.0
    passes_on: bool = False


def roofline(config: Config, batch: int, ceiling: float, budget: float) -> dict[str, Any]:
    """Measures each kind of operation alone: those of a training step, with gradient, and those of the tokenizer.

    Args:
        ceiling: operations a second of matrix products.
        budget: seconds per quantity.

    Returns:
        For each operation, for their sums and for one pass of cached sampling: the seconds in a whole step (or for one
        image), the least seconds, and the ratio least / measured. Also the bandwidth. Empty for a family other than
        RoboScape and Genie.
    """
    model = create_model(config)
    if not isinstance(model, RoboScape):
        return {}
    speed = bandwidth(budget)
    measure = partial(_measure, ceiling=ceiling, speed=speed, budget=budget)
    step = {each.name: measure(each) for each in operations(model.architecture, config, batch)}
    step["optimizer"] = _optimizer(config, model, speed, budget)
    numbers: dict[str, Any] = {"roofline_bandwidth_bytes_per_s": speed} | _rows("roofline", step)
    for half, products in tokenizer_operations(config.tokenizer, config.clips.image_size).items():
        numbers |= _rows(f"roofline_{half}", {each.name: measure(each, gradient=False) for each in products})
    # A cached pass reads parameters and cache once.
    params = jax.jit(model.init)(jax.random.key(0))
    cache = full_cache(model, batch)
    run = jax.jit(cached_pass(model, batch))
    seconds = median_seconds(lambda: run(params, cache), budget)
    read = sum(x.nbytes for x in jax.tree.leaves((params, cache)))
    least = max(pass_flops(model.architecture, cache) / ceiling, read / speed)
    return numbers | _row("roofline_cached_pass", seconds, least)


def _row(name: str, seconds: float, least: float) -> dict[str, float]:
    return {f"{name}_s": seconds, f"{name}_least_s": least, f"{name}_share": least / seconds}


def _rows(prefix: str, rows: dict[str, tuple[float, float]]) -> dict[str, float]:
    """Returns the numbers of several operations and of their sum; ``rows`` holds seconds and least seconds of each."""
    rows = rows | {"sum": (sum(row[0] for row in rows.values()), sum(row[1] for row in rows.values()))}
    return {key: x for name, row in rows.items() for key, x in _row(f"{prefix}_{name}", *row).items()}


def bandwidth(budget: float) -> float:
    """Returns the bytes a second that adding two large arrays reads and writes."""
    x = jnp.ones(STREAM)
    y = jnp.ones(STREAM)
    add = jax.jit(jnp.add)
    return 3 * FLOAT * STREAM / median_seconds(lambda: add(x, y), budget)


def operations(arch: Architecture, config: Config, batch: int) -> tuple[Operation, ...]:
    """Returns the operations of a training step's forward pass, without rematerialisation, embeddings and actions."""
    frames = config.clips.frames
    by_name: dict[str, Operation] = {}
    for modality in arch.modalities:
        for each in _branch_operations(arch, modality, frames, batch):
            name = each.name
            if not each.times:
                continue
            if name in by_name and by_name[name].shapes != each.shapes:
                name = f"{modality}_{name}"
            times = each.times
            if name in by_name:
                times += by_name[name].times
            by_name[name] = replace(each, name=name, times=times)
    return tuple(by_name.values())


def _branch_operations(arch: Architecture, modality: str, frames: int, batch: int) -> tuple[Operation, ...]:
    """Returns the operations of a modality: those of its head, and if it has a branch, of that."""
    sizes = arch.sizes(modality)
    width = sizes.width
    hidden = sizes.public.mlp_ratio * width
    heads = sizes.heads
    cells = sizes.grid**2
    rows = batch * frames * cells
    bf16 = arch.compute_dtype == "bfloat16"
    blocks = sizes.blocks * (modality in arch.branches)
    norms = blocks * (4 if arch.public.qk_norm else 2)
    if arch.departures.more_norms:
        norms += blocks + 1
    joint = blocks * (modality == "depth")  # depth → RGB
    coarse = (arch.grid // sizes.grid) ** 2
    merges = (1 + arch.departures.read_previous) * (coarse > 1)
    codes = coarse * arch.vocabularies * arch.vocabulary_size

    def product(name: str, times: int, inputs: int, outputs: int) -> Operation:
        layer = Dense(outputs, bf16, use_bias=False)
        run = lambda x, kernel: layer.apply({"params": {"kernel": kernel}}, x)  # noqa: E731
        return Operation(name, times, run, ((rows, inputs), (inputs, outputs)), 2.0 * rows * inputs * outputs)

    def norm(x: Any, scale: Any, bias: Any) -> Any:
        return layer_norm(None).apply({"params": {"scale": scale, "bias": bias}}, x)

    def over_time(q: Any, k: Any, v: Any) -> Any:
        return attend(q, k, v, jnp.tril(jnp.ones((frames, frames), bool)))

    def cross_entropy(logits: Any) -> Any:
        return optax.softmax_cross_entropy_with_integer_labels(logits, jnp.zeros(logits.shape[:-1], jnp.int32))

    def attention(name: str, run: Any, groups: int, keys: int) -> Operation:
        shape = (batch, groups, keys, heads, width // heads)
        return Operation(name, blocks, run, (shape,) * 3, 4.0 * rows * keys * width)

    vocabulary = (batch * frames * arch.grid**2, arch.vocabularies, arch.vocabulary_size)
    return (
        product("qkv", 2 * blocks, width, 3 * width),
        product("projection", 2 * blocks, width, width),
        product("depth_to_rgb", joint, width, arch.width),
        product("mlp_in", blocks, width, hidden),
        product("mlp_out", blocks, hidden, width),
        product("merge", merges, coarse * width, width),
        product("head", 1, width, codes),
        attention("attention_in_frames", partial(attend_cells, bf16=bf16), frames, cells),
        attention("attention_over_time", over_time, cells, frames),
        Operation("gelu", blocks, gelu, ((rows, hidden),)),
        Operation("norm", norms, norm, ((rows, width), (width,), (width,))),
        Operation("residual_sum", 3 * blocks, jnp.add, ((rows, width),) * 2, passes_on=True),
        Operation(
            "depth_to_rgb_sum", joint, jnp.add, ((batch * frames * arch.grid**2, arch.width),) * 2, passes_on=True
        ),
        Operation("loss", 1, cross_entropy, (vocabulary,)),
    )


def tokenizer_operations(config: TokenizerConfig, image_size: int) -> dict[str, tuple[Operation, ...]]:
    """Returns the distinct convolutions and linear layers that "encode" and "decode" one image."""
    network = Tokenizer(replace(config, compute_dtype="float32"))
    side = config.grid(image_size)
    bf16 = config.compute_dtype == "bfloat16"
    params = jax.eval_shape(network.init_params, jax.random.key(0))
    images = jax.ShapeDtypeStruct((1, image_size, image_size, 3), "float32")
    tokens = jax.ShapeDtypeStruct((1, side, side), "int32")

    def of(method: str, x: Any) -> tuple[Operation, ...]:
        by_name: dict[str, list[Operation]] = {}
        for each in _traced(jax.make_jaxpr(partial(network.apply, method=method))({"params": params}, x).jaxpr, bf16):
            by_name.setdefault(each.name, []).append(each)
        return tuple(replace(each[0], times=len(each)) for each in by_name.values())

    return {"encode": of("encode", images), "decode": of("decode", tokens)}


def _traced(jaxpr: Any, bf16: bool) -> Iterator[Operation]:
    """Yields the products of a float32 program, named after kernel, stride, channels and side of the result.

    Args:
        bf16: whether to run convolutions as a tokenizer in bf16 does.
    """
    for eqn in jaxpr.eqns:
        for inner in jaxprs_in_params(eqn.params):
            yield from _traced(inner, bf16)
        if eqn.primitive.name not in ("conv_general_dilated", "dot_general"):
            continue
        shapes = tuple(x.aval.shape for x in eqn.invars)
        out = eqn.outvars[0].aval.shape
        name = f"linear_{shapes[1][0]}_to_{out[-1]}"
        if eqn.primitive.name == "conv_general_dilated":
            rows, columns, inputs, outputs = shapes[1]
            stride = eqn.params["window_strides"][0]
            name = f"{rows}x{columns}{f'_stride_{stride}' * (stride > 1)}_{inputs}_to_{outputs}_at_{out[1]}"
        run = partial(eqn.primitive.bind, **eqn.params)
        plain = run
        if bf16 and eqn.primitive.name == "conv_general_dilated":
            run = partial(convolve, **eqn.params)
        yield Operation(name, 1, run, shapes, count_products(jax.make_jaxpr(plain)(*map(jnp.zeros, shapes)).jaxpr))


def cached_pass(model: RoboScape, batch: int) -> Callable[[Params, Cache], Any]:
    """Returns a pass over the last frame of a full window; it takes parameters and the cache of the earlier frames."""
    arch = model.architecture
    sample = model.config.sample
    actions = inputs.actions(arch, batch, 1)
    hidden = jnp.ones((batch, 1, arch.grid**2), bool)
    tokens = {name: cells.reshape(hidden.shape) for name, cells in inputs.prompt(arch, batch, 1).items()}

    def run(params: Params, cache: Cache) -> Any:
        start = jnp.asarray(arch.frames - 1)
        return apply_network(arch, sample, params, tokens, hidden, actions, start, cache, previous=tokens)[0]

    return run


def full_cache(model: RoboScape, batch: int) -> StackedCache:
    """Returns a cache of a full window."""
    return new_cache(model.architecture, model.config.sample, batch, cache_slots(model.architecture, 1))


def pass_flops(arch: Architecture, cache: StackedCache) -> int:
    """Returns the floating-point operations of a pass over one frame that attends to the cache and to itself."""
    _, clips, _, _, slots, _ = cache["rgb"].k.shape
    return clips * forward_flops(arch, slots + 1) // (slots + 1)


def _measure(
    operation: Operation, ceiling: float, speed: float, budget: float, gradient: bool = True
) -> tuple[float, float]:
    """Returns seconds and least seconds of an operation in all its places, with its gradient or without."""
    keys = jax.random.split(jax.random.key(0), len(operation.shapes))
    operands = [jax.random.normal(key, shape) for key, shape in zip(keys, operation.shapes, strict=True)]

    @jax.jit
    def both(cotangent: Any, *operands: Any) -> Any:
        out, pull = jax.vjp(operation.run, *operands)
        return out, pull(cotangent)

    out = jax.eval_shape(operation.run, *operands)
    forward = jax.jit(operation.run)
    cotangent = jnp.ones(out.shape, out.dtype)
    run = partial(forward, *operands)
    passes = 1
    if gradient:
        run = partial(both, cotangent, *operands)
        passes = 3
    seconds = median_seconds(run, budget)
    read = sum(x.size for x in operands)
    # Forward moves operands and result; the gradient moves operands, the result's gradient and the operands' gradients.
    moved = FLOAT * (read + out.size + (gradient and not operation.passes_on) * (2 * read + out.size))
    products = passes * operation.flops
    return operation.times * seconds, operation.times * max(products / ceiling, moved / speed)


def _optimizer(config: Config, model: RoboScape, speed: float, budget: float) -> tuple[float, float]:
    """Returns seconds and least seconds of a step of the optimizer; Muon's matrix products are not counted."""
    params = jax.jit(model.init)(jax.random.key(0))
    optimizer = make_optimizer(config.loop("world_model"))
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
