"""What a configuration comes to, from shapes alone: parameters by part, operations, and memory. Allocates nothing."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict, unflatten_dict
from rich.console import Group
from rich.table import Table
from rich.tree import Tree

from rsjax.clip import Batch
from rsjax.config import Config, ModelConfig
from rsjax.models.roboscape import losses
from rsjax.models.roboscape.flops import forward_flops, train_flops
from rsjax.models.roboscape.terms import world_model_terms
from rsjax.models.roboscape.world_model import empty_cache
from rsjax.tokenizers.flops import tokenizer_flops
from rsjax.training.objectives import TokenizerObjective, WorldModelObjective
from rsjax.training.state import make_optimizer

Shapes = dict[str, Any]  # nested, with ShapeDtypeStructs at the leaves

# Of clips, in shapes: a prime that divides no dimension of a model, so that an array's size tells whether it grows with
# the batch.
_CLIPS = 10_007


@dataclass(frozen=True)
class Description:
    """A configuration's networks and their figures.

    Attributes:
        modules: shapes of the parameters by network, then part: "rgb", "depth", "projections" (depth → RGB) and
            "shared" (positions, actions) of the world model; "encoder", "decoder" and perhaps "discriminator" of the
            tokenizer. Blocks of the world model are stacked along a leading axis.
        figures: see :func:`figures`.
    """

    name: str
    modules: dict[str, Shapes]
    figures: dict[str, int]


def describe(config: Config) -> Description:
    """Shapes and figures of the configuration's world model and tokenizer."""
    world_model = jax.eval_shape(WorldModelObjective.create(config).init, jax.random.key(0))
    modules = {"world_model": by_part(world_model), "tokenizer": _tokenizer(config)}
    return Description(config.name, modules, figures(config, modules))


def by_part(world_model: Shapes) -> Shapes:
    """The world model's parameters by what they belong to: rgb, depth, projections, shared."""
    parts: dict[str, dict[tuple[str, ...], Any]] = {}
    for path, x in flatten_dict(world_model).items():
        parts.setdefault(_part(path), {})[path] = x
    return {name: unflatten_dict(parts[name]) for name in ("rgb", "depth", "projections", "shared") if name in parts}


def _part(path: tuple[str, ...]) -> str:
    if "depth_to_rgb" in path:
        return "projections"
    first_words = [name.partition("_")[0] for name in path]
    return next((branch for branch in ("rgb", "depth") if branch in first_words), "shared")


def _tokenizer(config: Config) -> Shapes:
    shapes = jax.eval_shape(TokenizerObjective(config.tokenizer, config.tokenizer_train).init, jax.random.key(0))
    if config.tokenizer_train.adversarial:
        return shapes["generator"] | {"discriminator": shapes["discriminator"]}
    return shapes


def figures(config: Config, modules: dict[str, Shapes]) -> dict[str, int]:
    """Counts of parameters, operations and bytes, by flat names.

    - ``params_…``: of each part and network; ``params_one_branch``: of the RGB branch with what it shares, which is the
      model without depth.
    - ``flops_…``: matrix products and convolutions at 2 a multiply-add (``flops.py`` of model and tokenizer). Per
      frame: a forward pass over a clip by its frames, and about a pass of one frame through the cache. Training: three
      forwards, without what remat repeats.
    - ``bytes_train_state``: of the world model's parameters, optimizer, averages and gradients. Once a device.
    - ``bytes_activations_per_clip``: what the backward pass keeps of the forward pass, that and the loss as autodiff
      sees them; the compiler may keep less. ``…_remat``: each block's input, and all of the one block that is being
      recomputed. ``model.remat`` says what applies: none or blocks; products lies between.
    - ``bytes_cache_…``: temporal keys and values of one rollout of ``model.frames`` frames.
    """
    model, world, tokenizer = config.model, modules["world_model"], modules["tokenizer"]
    counts = {part: count(shapes) for part, shapes in world.items()}
    pass_over_clip = forward_flops(model, model.frames)
    pixels = tokenizer_flops(config.tokenizer)
    activations = activation_bytes(config)
    return {
        **{f"params_{part}": n for part, n in counts.items()},
        "params_world_model": sum(counts.values()),
        "params_one_branch": counts["rgb"] + counts["shared"],
        **{f"params_{part}": count(shapes) for part, shapes in tokenizer.items()},
        "flops_per_frame": pass_over_clip // model.frames,
        "flops_train_per_clip": train_flops(model, model.frames, 1),
        "flops_encode_per_image": pixels["encoder"],
        "flops_decode_per_image": pixels["decoder"],
        "bytes_train_state": _train_state_bytes(config, world),
        "bytes_activations_per_clip": activations[False],
        "bytes_activations_per_clip_remat": activations[True],
        "bytes_cache_float32": cache_bytes(model, 4),
        "bytes_cache_bfloat16": cache_bytes(model, 2),
    }


def count(shapes: Shapes) -> int:
    """Numbers in a tree of arrays or shapes."""
    return sum(x.size for x in jax.tree.leaves(shapes))


def cache_bytes(model: ModelConfig, bytes_per_number: int) -> int:
    """Bytes of one rollout's temporal keys and values, all blocks and branches."""
    cache = jax.eval_shape(lambda: empty_cache(model, 1, model.frames))
    return count(cache) * bytes_per_number


def _train_state_bytes(config: Config, params: Shapes) -> int:
    optimizer = jax.eval_shape(make_optimizer(config.train).init, params)
    copies = 3 if config.train.ema else 2  # parameters, gradients, averages
    return copies * _bytes(params) + _bytes(optimizer)


def activation_bytes(config: Config) -> dict[bool, int]:
    """Bytes per clip that training keeps for the backward pass, without remat (False) and with it (True)."""
    plain, remat = (_kept(config, replace(config.model, remat=on)) for on in ("none", "blocks"))
    blocks = config.model.blocks
    one_block = sum(_bytes(x) for x in plain if x.shape[0] == blocks) // blocks
    return {False: sum(map(_bytes, plain)) // _CLIPS, True: (sum(map(_bytes, remat)) + one_block) // _CLIPS}


def _kept(config: Config, model: ModelConfig) -> list[jax.ShapeDtypeStruct]:
    """What grows with the batch of all that the loss's forward pass keeps, on a batch of ``_CLIPS`` clips."""
    params = jax.eval_shape(WorldModelObjective(model, config.mask, config.loss).init, jax.random.key(0))
    weights = config.loss.terms(model.depth)

    def backward(params: Any, batch: Batch, key: jax.Array) -> Any:
        def loss(params: Any) -> Any:
            return losses.combine(world_model_terms(model, config.mask, config.loss, params, batch, key), weights)[0]

        return jax.vjp(loss, params)[1]  # a tree whose leaves are what it keeps

    kept = jax.eval_shape(backward, params, _batch(config, _CLIPS), jax.random.key(0))
    return [x for x in jax.tree.leaves(kept) if x.size % _CLIPS == 0]


def _batch(config: Config, clips: int) -> Any:
    model, tracks = config.model, config.clips.tracks
    shape: Callable[..., Any] = lambda dtype, *axes: jax.ShapeDtypeStruct((clips, *axes), dtype)  # noqa: E731
    tokens = shape(jnp.int32, model.frames, model.grid, model.grid)
    return Batch(
        rgb=tokens,
        depth=tokens,
        actions=shape(jnp.float32, model.frames, model.action_dim),
        tracks=shape(jnp.float32, tracks, model.frames, 2),
        visible=shape(jnp.bool_, tracks, model.frames),
        weight=shape(jnp.float32),
        index=shape(jnp.int32),
    )


def _bytes(tree: Any) -> int:
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def render(description: Description) -> Group:
    """Trees of modules with shapes and counts, and a table of the figures, for a rich console."""
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
        table.add_row(_title(name), f"{value:,}", _short(name, value))
    return Group(*trees, table)


def _grow(tree: Tree, shapes: Shapes) -> None:
    """A line for each module that has parameters of its own, within those that hold it."""
    for name, x in shapes.items():
        inner = {key: y for key, y in x.items() if isinstance(y, dict)} if isinstance(x, dict) else {}
        own = [f"{key} {y.shape}" for key, y in _leaves(x) if key not in inner]
        _grow(tree.add("  ".join([name, *own, f"[dim]{count(x):,}[/]"])), inner)


def _leaves(x: Any) -> Iterator[tuple[str, Any]]:
    yield from x.items() if isinstance(x, dict) else [("", x)]


def _title(name: str) -> str:
    return name.replace("_", " ")


def _short(name: str, value: int) -> str:
    unit = {"bytes": "B", "flops": "FLOP"}.get(name.partition("_")[0], "")
    size = next((e for e in (12, 9, 6, 3) if value >= 10**e), 0)
    return f"{value / 10**size:.3g} {dict(zip((12, 9, 6, 3, 0), 'TGMk ', strict=True))[size].strip()}{unit}"
