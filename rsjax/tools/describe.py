"""Counts a configuration's parameters, operations and memory from shapes, without allocating arrays."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict, unflatten_dict
from rich.console import Group
from rich.table import Table
from rich.tree import Tree

from rsjax.config import Config
from rsjax.models.base import create_autoencoder, create_model
from rsjax.tools.bench import inputs
from rsjax.trainable import Params, StepContext
from rsjax.training.state import make_optimizer
from rsjax.training.step import combine

Shapes = dict[str, Any]  # nested, with ShapeDtypeStructs at the leaves

# The batch size in shapes: a large prime, so that only arrays that grow with the batch have a size divisible by it.
_CLIPS = 10_007
CACHE_BYTES = {"float32": 4, "bfloat16": 2}
PREFIXES = {12: "T", 9: "G", 6: "M", 3: "k", 0: ""}  # by power of ten


@dataclass(frozen=True)
class Description:
    """Networks of a configuration, and figures about them.

    Attributes:
        modules: shapes of parameters by network and part: "rgb", "depth", "projections" (depth → RGB) and "shared"
            (positions, actions) of the world model; "encoder", "decoder" and perhaps "discriminator" of the tokenizer.
            Blocks of the world model are stacked along a leading axis.
        figures: see :func:`figures`.
    """

    name: str
    modules: dict[str, Shapes]
    figures: dict[str, int]


def describe(config: Config) -> Description:
    """Returns shapes and figures of the configuration's world model and tokenizer."""
    modules = {"world_model": by_part(jax.eval_shape(create_model(config).init, jax.random.key(0)))}
    if config.model.uses_tokenizer:
        shapes = jax.eval_shape(create_autoencoder(config).init, jax.random.key(0))
        if "generator" in shapes:
            shapes = shapes["generator"] | {"discriminator": shapes["discriminator"]}
        modules["tokenizer"] = shapes
    return Description(config.name, modules, figures(config, modules))


def by_part(world_model: Shapes) -> Shapes:
    """Groups the world model's parameters by part: rgb, depth, projections, shared."""
    parts: dict[str, dict[tuple[str, ...], Any]] = {}
    for path, x in flatten_dict(world_model).items():
        first_words = [name.partition("_")[0] for name in path]
        part = next((branch for branch in ("rgb", "depth") if branch in first_words), "shared")
        if "depth_to_rgb" in path:
            part = "projections"
        parts.setdefault(part, {})[path] = x
    return {name: unflatten_dict(parts[name]) for name in ("rgb", "depth", "projections", "shared") if name in parts}


def figures(config: Config, modules: dict[str, Shapes]) -> dict[str, int]:
    """Counts parameters, operations and bytes, and returns them by flat names.

    - ``params_…``: of each part and network; ``params_one_branch``: of the RGB branch and the shared part, that is, of
      the model without depth.
    - ``flops_…``: matrix products and convolutions, 2 per multiply-add (``flops.py`` of model and tokenizer). Per
      frame: those of a forward pass over a clip, divided by its frames, which is about the cost of one frame with the
      cache. Training: those of three forward passes, without what remat repeats.
    - ``bytes_train_state``: of the world model's parameters, optimizer state, averages and gradients, per device.
    - ``bytes_activations_per_clip``: what automatic differentiation keeps of forward pass and loss; the compiler may
      keep less. ``…_remat``: each block's inputs, a depth block's output, and everything of the block that is being
      recomputed. The first is for ``model.remat`` "none", the second for "blocks"; "products" is between them.
    - ``bytes_cache_…``: keys and values that one rollout of a clip's length keeps, for a family with a cache.
    """
    model = create_model(config)
    world = modules["world_model"]
    counts = {part: count(shapes) for part, shapes in world.items()}
    frames = config.clips.frames
    flops = model.flops(config.clips.frames)
    activations = activation_bytes(config)
    numbers = {
        **{f"params_{part}": n for part, n in counts.items()},
        "params_world_model": sum(counts.values()),
        "params_one_branch": counts.get("rgb", 0) + counts.get("shared", 0),
        **{f"params_{part}": count(shapes) for part, shapes in modules.get("tokenizer", {}).items()},
    }
    if flops:
        numbers |= {"flops_per_frame": flops["forward"] // frames, "flops_train_per_clip": flops["train"]}
    if config.model.uses_tokenizer and (pixels := create_autoencoder(config).flops()):
        numbers |= {"flops_encode_per_image": pixels["encoder"], "flops_decode_per_image": pixels["decoder"]}
    optimizer = jax.eval_shape(make_optimizer(config.loop("world_model")).init, world)
    copies = 3 if config.train.ema else 2  # parameters, gradients, averages
    numbers |= {
        "bytes_train_state": copies * _bytes(world) + _bytes(optimizer),
        "bytes_activations_per_clip": activations[False],
        "bytes_activations_per_clip_remat": activations[True],
    }
    cached = count(model.cache_shapes(config.clips.frames))
    return numbers | {f"bytes_cache_{name}": cached * n for name, n in CACHE_BYTES.items() if cached}


def count(shapes: Shapes) -> int:
    """Returns the number of elements in a tree of arrays or shapes."""
    return sum(x.size for x in jax.tree.leaves(shapes))


def activation_bytes(config: Config) -> dict[bool, int]:
    """Returns bytes per clip that training keeps for the backward pass, without remat (False) and with it (True).

    Both are equal for a family without such blocks (``ModelConfig.scanned``).
    """
    blocks = config.model.scanned
    if not blocks:
        kept = sum(map(_bytes, _kept(config))) // _CLIPS
        return {False: kept, True: kept}
    with_remat = (replace(config, model=replace(config.model, remat=on)) for on in ("none", "blocks"))  # type: ignore[call-arg]
    plain, remat = map(_kept, with_remat)
    one_block = sum(_bytes(x) for x in plain if x.shape[0] == blocks) // blocks
    return {False: sum(map(_bytes, plain)) // _CLIPS, True: (sum(map(_bytes, remat)) + one_block) // _CLIPS}


def _kept(config: Config) -> list[jax.ShapeDtypeStruct]:
    """Returns the arrays of ``_CLIPS`` clips that the loss keeps for its backward pass and that grow with the batch."""
    model = create_model(config)
    params = jax.eval_shape(model.init, jax.random.key(0))

    def backward(params: Params, batch: Any, key: jax.Array) -> Any:
        def loss(params: Params) -> Any:
            context = StepContext(jnp.int32(0), None, None)
            return combine(model.loss_terms(params, batch, key, context), model.loss_weights)[0]

        return jax.vjp(loss, params)[1]  # a tree of the arrays that are kept

    with inputs.random_files(config) as readable:
        one = inputs.batch_shapes(create_model(readable), readable)
    batch = jax.tree.map(lambda x: jax.ShapeDtypeStruct((_CLIPS, *x.shape[1:]), x.dtype), one)
    kept = jax.eval_shape(backward, params, batch, jax.random.key(0))
    return [x for x in jax.tree.leaves(kept) if x.size % _CLIPS == 0]


def _bytes(tree: Any) -> int:
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def render(description: Description) -> Group:
    """Returns trees of modules with shapes and counts, and a table of the figures, for a rich console."""
    trees = []
    for network, parts in description.modules.items():
        tree = Tree(f"[bold]{description.name}: {_title(network)}[/]  {count(parts):,}")
        for part, shapes in parts.items():
            _grow(tree.add(f"[bold]{_title(part)}[/]  {count(shapes):,}"), shapes)
        trees.append(tree)
    table = Table("figure", title=description.name)
    table.add_column("value", justify="right")
    table.add_column("", justify="right")
    for name, value in description.figures.items():
        unit = {"bytes": "B", "flops": "FLOP"}.get(name.partition("_")[0], "")
        exponent = next((exponent for exponent in PREFIXES if value >= 10**exponent), 0)
        table.add_row(_title(name), f"{value:,}", f"{value / 10**exponent:.3g} {PREFIXES[exponent]}{unit}")
    return Group(*trees, table)


def _grow(tree: Tree, shapes: Shapes) -> None:
    """Adds a line for each module with its own parameters, nested as the modules are."""
    for name, x in shapes.items():
        parts = x if isinstance(x, dict) else {"": x}
        inner = {key: y for key, y in parts.items() if isinstance(y, dict)}
        own = [f"{key} {y.shape}" for key, y in parts.items() if key not in inner]
        _grow(tree.add("  ".join([name, *own, f"[dim]{count(x):,}[/]"])), inner)


def _title(name: str) -> str:
    return name.replace("_", " ")
