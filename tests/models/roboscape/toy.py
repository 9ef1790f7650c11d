"""A world model small enough to be computed once more in plain numpy, with random parameters and inputs."""

import math
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from rsjax.config import ClipShape, PublicCodeConfig, RoboScapeConfig, TokenizerConfig, TokenModelConfig
from rsjax.config.config_fields import with_values
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.model import RoboScape
from rsjax.models.roboscape.transformer import Transformer


def depart(architecture: Architecture, **departures: Any) -> Architecture:
    """The architecture with these departures from the paper besides its own."""
    return replace(architecture, departures=replace(architecture.departures, **departures))


DUAL = Architecture(frames=5, grid=2, code_bits=4, action_inputs=3, width=8, blocks=2, heads=2)
RGB = replace(DUAL, depth="none")
HEAD = replace(DUAL, depth="head")
COARSE = replace(DUAL, depth_cells=2)
NORMED = depart(DUAL, more_norms=True)
QK_NORM = replace(DUAL, public_code=PublicCodeConfig(qk_norm=True, mup=True))
READS_PREVIOUS = depart(DUAL, read_previous=True)
WHOLE = depart(READS_PREVIOUS, whole_frames=True)
SMALL = replace(READS_PREVIOUS, blocks=4, grid=4, depth_width=4, depth_blocks=2, depth_cells=2)
GENIE = replace(RGB, action_encoder="none", action_inputs=0)
GUIDED = depart(DUAL, action_dropout=0.5)
ADAPTIVE = replace(NORMED, action_encoder="norms")
BATCH = 2


def roboscape(architecture: Architecture, config: TokenModelConfig | None = None, prompt_frames: int = 1) -> RoboScape:
    """A model of this architecture, whatever clips and tokenizer that would follow from."""
    if config is None:
        config = with_values(RoboScapeConfig(departures=architecture.departures), {"depth": architecture.depth})
    clips = ClipShape(architecture.frames, 64, 7, architecture.action_inputs, 2)
    return RoboScape(config, architecture, prompt_frames, TokenizerConfig(), clips)


def forward(config: Architecture, params: Any, inputs: tuple) -> dict[str, np.ndarray]:
    logits, cache = apply(config, params, *inputs)
    assert cache is None
    return jax.tree.map(np.asarray, logits)


def apply_plain(
    config: Architecture,
    params: Any,
    tokens: Any,
    mask: Any,
    actions: Any,
    start: Any = 0,
    cache: Any = None,
    drop_actions: Any = None,
    no_depth: Any = None,
) -> Any:
    return Transformer(config).apply({"params": params}, tokens, mask, actions, start, cache, drop_actions, no_depth)


apply = jax.jit(apply_plain, static_argnums=0)


def random_params(config: Architecture, seed: int = 0) -> Any:
    """Parameters without a zero among them, so that nothing hides behind an initial value."""
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(Transformer(config).init_params, jax.random.key(0))
    return jax.tree.map(lambda x: rng.normal(scale=0.4, size=x.shape).astype(np.float32), shapes)


def random_inputs(config: Architecture, seed: int = 0) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    shape = (BATCH, config.frames, config.grid, config.grid)
    tokens = {name: rng.integers(0, 2**config.code_bits, shape, np.int32) for name in config.modalities}
    return (
        tokens,
        rng.random(shape) < 0.4,
        rng.normal(size=(BATCH, config.frames, config.action_inputs)).astype(np.float32),
    )


def blind(params: Any) -> Any:
    """Parameters to whose depth branch every token looks as a masked one does."""
    tables = jax.tree.map(np.zeros_like, params["depth_embed"])
    hidden = params["depth_embed"]["mask_token_embed"]
    tables["factored_embed_0"]["embedding"] += hidden
    return params | {"depth_embed": tables | {"mask_token_embed": hidden}}


# The model once more, cell by cell, from the paper's §2.3 and the public Genie's layout.


def softmax(x: np.ndarray) -> np.ndarray:
    e = np.exp(x - x.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


def gelu(x: np.ndarray) -> np.ndarray:
    return x * 0.5 * (1 + np.vectorize(math.erf)(x / math.sqrt(2)))


def layer_norm(x: np.ndarray, p: dict) -> np.ndarray:
    centred = x - x.mean(-1, keepdims=True)
    return centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-5) * p["scale"] + p["bias"]


def sequence_attention(x: np.ndarray, p: dict, config: Architecture, causal: bool) -> np.ndarray:
    """Attention over one sequence (L, C)."""
    length, width = x.shape
    heads = config.heads
    qkv = (x @ p["qkv"]["kernel"]).reshape(length, 3, heads, width // heads)
    if config.public.qk_norm:
        qkv[:, :2] = layer_norm(qkv[:, :2], p["norm"])
    scale = 8 / (width // heads) if config.public.mup else 1 / math.sqrt(width // heads)
    out = np.zeros((length, heads, width // heads))
    for head in range(heads):
        for i in range(length):
            last = i + 1 if causal else length
            scores = qkv[:last, 1, head] @ qkv[i, 0, head] * scale
            out[i, head] = softmax(scores) @ qkv[:last, 2, head]
    return out.reshape(length, width) @ p["proj"]["kernel"] + p["proj"]["bias"]


def st_block(x: np.ndarray, p: dict, config: Architecture, action: np.ndarray | None) -> np.ndarray:
    """A block; ``action`` (B, T, 1, C) is None unless the norms are read from it."""
    x = x.copy()
    b, t, s, _ = x.shape
    changes = np.zeros((9, b, t, 1, 1))  # gate, scale and shift over space, of the MLP and over time
    if action is not None:
        linear = p["action_norms"]["linear"]
        read = (action / (1 + np.exp(-action))) @ linear["kernel"] + linear["bias"]
        changes = np.zeros((9, *x.shape[:2], 1, x.shape[3]))
        parts = np.split(read, read.shape[-1] // x.shape[3], axis=-1)
        changes[: len(parts)] = parts
    gates = 1 + changes[[0, 6, 3]]
    scales = 1 + changes[[1, 7, 4]]
    shifts = changes[[2, 8, 5]]
    normed = x.copy() if config.public.qk_norm else layer_norm(x, p["norm1"]) * scales[0] + shifts[0]
    out = [[sequence_attention(normed[i, j], p["spatial_attn"], config, False) for j in range(t)] for i in range(b)]
    x += gates[0] * np.array(out)
    before = x.copy()
    if config.departures.more_norms:
        before = layer_norm(x, p["norm_temporal"]) * scales[1] + shifts[1]
    for i in range(b):
        for cell in range(s):
            passed = sequence_attention(before[i, :, cell], p["temporal_attn"], config, True)
            x[i, :, cell] += gates[1][i, :, 0] * passed
    normed = x if config.public.qk_norm else layer_norm(x, p["norm2"]) * scales[2] + shifts[2]
    hidden = gelu(normed @ p["fc1"]["kernel"] + p["fc1"]["bias"])
    return x + gates[2] * (hidden @ p["fc2"]["kernel"] + p["fc2"]["bias"])


def embed(tokens: np.ndarray, mask: np.ndarray, p: dict, config: Architecture) -> np.ndarray:
    x = sum(
        p[f"factored_embed_{k}"]["embedding"][(tokens // config.vocabulary_size**k) % config.vocabulary_size]
        for k in range(config.vocabularies)
    )
    x[mask] = p["mask_token_embed"]
    return x


def plain_forward(config: Architecture, params: Any, inputs: tuple) -> dict[str, np.ndarray]:
    tokens, mask, actions = inputs
    p = jax.tree.map(lambda x: np.asarray(x, np.float64), params)
    b, t = mask.shape[:2]
    if config.departures.whole_frames:
        mask = mask.copy()
        mask[:, 1:] = True
    h = {}
    conditions: dict[str, Any] = {}
    for name in config.inputs:
        grid = tokens[name]
        flat = grid.reshape(b, t, -1)
        x = merge(embed(flat, mask.reshape(b, t, -1), p[f"{name}_embed"], config), name, "embed", p, config)
        if config.departures.read_previous:
            absent = np.broadcast_to((np.arange(t) == 0)[None, :, None], flat.shape)
            before = embed(np.roll(flat, 1, axis=1), absent, p[f"{name}_previous_embed"], config)
            x += merge(before, name, "previous_embed", p, config)
        prefix = "depth_" * (name == "depth" and "depth_pos_embed" in p)
        h[name] = x
        if name in config.branches:
            h[name] = h[name] + p[f"{prefix}pos_embed"][:t]
        if name in config.branches and config.action_inputs:
            encoder = p[f"{prefix}action_encoder"]
            encoded = (actions @ encoder["kernel"] + encoder["bias"])[:, :, None]
            if config.action_encoder == "norms":
                conditions[name] = encoded
            else:
                h[name] += encoded
    if config.depth == "head":
        h = {"rgb": sum(h.values(), np.zeros(()))}
    for block in range(config.blocks):
        group, place = divmod(block, config.blocks // config.groups)
        own = jax.tree.map(lambda x, group=group: x[group], p["blocks"])
        parameters = own["rgb" if place == 0 else f"rgb_{place}"]
        h["rgb"] = st_block(h["rgb"], parameters, config, conditions.get("rgb"))
        if config.depth == "branch" and place == 0:
            h["depth"] = st_block(h["depth"], own["depth"], config.sizes("depth"), conditions.get("depth"))
            joining = h["depth"] @ own["depth_to_rgb"]["kernel"] + own["depth_to_rgb"]["bias"]
            h["rgb"] = h["rgb"] + joining[:, :, coarse_cell(config)]
    if config.depth == "head":
        h["depth"] = h["rgb"]
    if config.departures.more_norms:
        h = {name: layer_norm(x, p[f"{name}_norm_out"]) for name, x in h.items()}
    if config.public.mup:
        h = {name: x * 256 / x.shape[-1] for name, x in h.items()}
    logits = {name: x @ p[f"{name}_head"]["kernel"] + p[f"{name}_head"]["bias"] for name, x in h.items()}
    if config.depth_cells > 1:
        each = logits["depth"].reshape(b, t, -1, config.depth_cells**2, logits["rgb"].shape[-1])
        logits["depth"] = each[:, :, coarse_cell(config), place_in_coarse_cell(config)]
    return {name: x.reshape(b, t, -1, config.vocabularies, config.vocabulary_size) for name, x in logits.items()}


def coarse_cell(config: Architecture) -> np.ndarray:
    """Each cell's coarse cell."""
    n = config.depth_cells
    return np.array([i // n * (config.grid // n) + j // n for i in range(config.grid) for j in range(config.grid)])


def place_in_coarse_cell(config: Architecture) -> np.ndarray:
    """Each cell's place among those of its coarse cell."""
    n = config.depth_cells
    return np.array([i % n * n + j % n for i in range(config.grid) for j in range(config.grid)])


def merge(x: np.ndarray, name: str, table: str, p: Any, config: Architecture) -> np.ndarray:
    """The embeddings of a branch's cells, each of several cells where those of depth are coarser."""
    if name == "rgb" or config.depth_cells == 1:
        return x
    layer = p[f"{name}_{table}_merge"]
    kernel = layer["kernel"].reshape(config.depth_cells**2, x.shape[-1], -1)
    out = np.zeros((*x.shape[:2], (config.grid // config.depth_cells) ** 2, x.shape[-1]))
    for cell, (coarse, place) in enumerate(zip(coarse_cell(config), place_in_coarse_cell(config), strict=True)):
        out[:, :, coarse] += x[:, :, cell] @ kernel[place]
    return out + layer["bias"]
