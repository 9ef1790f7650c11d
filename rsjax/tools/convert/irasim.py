"""Maps the names of the public IRASim checkpoints to the transformer's parameters.

The weights' shapes reveal neither the number of heads nor the token grid of a frame; the parameters do not depend on
the grid. The file's fixed positions are left aside: the network computes its own.
"""

import json
import math
from pathlib import Path
from typing import Literal

import jax

from rsjax.config import ConfigError, to_dict
from rsjax.models.diffusion.layers import grid_positions, positions
from rsjax.models.irasim.dit import Architecture, DiT
from rsjax.tools.convert.directory import load_irasim, save
from rsjax.tools.convert.files import (
    HOLDERS,
    REPLACES,
    ConvertError,
    Tensors,
    check_file,
    exported_config,
    left_aside,
    read_tensors,
    write_safetensors,
)
from rsjax.tools.convert.table import SAME_NAMES, Entry, Names, Table, shape_of, to_params, to_tensors, weight_and_bias
from rsjax.trainable import Params

METADATA = "rsjax.irasim"  # key of the architecture in the metadata of an exported file
FIXED = ("pos_embed", "temp_embed")
HEADS = {1152: 16, 1024: 16, 768: 12, 384: 6}  # attention heads of the public sizes, by width


def table(config: Architecture) -> Table:
    """Returns an entry for each public tensor of the network except the positions."""
    linear = config.action_activation == "none"
    if linear:
        first = "embed_arm_state"
        second = "embed_state"
    else:
        first = "embed_state.fc1"
        second = "embed_state.fc2"
    entries: list[Entry] = [
        *weight_and_bias("x_embedder.proj", "patches", "conv"),
        *weight_and_bias("t_embedder.mlp.0", "time/fc1", "linear"),
        *weight_and_bias("t_embedder.mlp.2", "time/fc2", "linear"),
        *weight_and_bias(first, "action_fc1", "linear"),
        *weight_and_bias(second, "action_fc2", "linear"),
        Entry("mask_emb_fn.weight", "unknown_action"),
        *weight_and_bias("final_layer.linear", "final", "linear"),
        *weight_and_bias("final_layer.adaLN_modulation.1", "final_ada", "linear"),
    ]
    parts = {"attn.qkv": "qkv", "attn.proj": "proj", "mlp.fc1": "fc1", "mlp.fc2": "fc2", "adaLN_modulation.1": "ada"}
    for i in range(config.blocks):
        path = f"blocks/{('spatial', 'temporal')[i % 2]}"
        for public, own in parts.items():
            entries += weight_and_bias(f"blocks.{i}.{public}", f"{path}/{own}", "linear", i // 2)
    return tuple(entries)


def infer_config(source: object, tensors: Tensors, heads: int | None = None, names: Names = SAME_NAMES) -> Architecture:
    """Infers the network from the names and shapes of its tensors.

    Args:
        heads: attention heads, needed if the width is none of the public sizes'.
        names: the tensors' names in the file, where they differ, for error messages.

    Raises:
        ConvertError: the tensors are not an IRASim's, or leave the number of heads unknown.
    """

    def shape(key: str, axes: int) -> tuple[int, ...]:
        return shape_of(source, tensors, key, axes, names)

    if not {"mask_emb_fn.weight", "x_embedder.proj.weight"} <= tensors.keys():
        raise ConvertError(f"{source}: holds no weights of an IRASim, such as mask_emb_fn.weight")
    width, channels, patch, _ = shape("x_embedder.proj.weight", 4)
    (_, cells, _) = shape("pos_embed", 3)
    (_, frames, _) = shape("temp_embed", 3)
    linear = "embed_arm_state.weight" in tensors
    inputs = shape("embed_arm_state.weight" if linear else "embed_state.fc1.weight", 2)[1]
    # Frame-Ada reads one action at a time; Video-Ada reads all (frames - 1) actions of a clip.
    video = frames > 2 and inputs % (frames - 1) == 0 and inputs > frames - 1
    heads = heads or HEADS.get(width)
    if heads is None:
        raise ConvertError(f"{source}: of width {width}, which is none of the public sizes; set --heads")
    rows = max(rows for rows in range(1, math.isqrt(cells) + 1) if cells % rows == 0)
    try:
        return Architecture(
            conditioning="video" if video else "frame",
            action_activation="none" if linear else "gelu",
            width=width,
            blocks=sum(name.startswith("blocks.") and name.endswith(".attn.qkv.weight") for name in tensors),
            heads=heads,
            mlp_ratio=max(1, shape("blocks.0.mlp.fc1.weight", 2)[0] // width),
            patch_size=patch,
            frames=frames,
            rows=rows * patch,
            columns=cells // rows * patch,
            channels=channels,
            action_inputs=inputs // (frames - 1) if video else inputs,
        )
    except ConfigError as error:
        raise ConvertError(f"{source}: the network inferred from its tensors cannot be built: {error}") from error


def from_public(
    source: object,
    tensors: Tensors,
    own: Architecture | None = None,
    heads: int | None = None,
    names: Names = SAME_NAMES,
) -> tuple[Architecture, Params, int]:
    """Returns a model's architecture, its parameters and how many tensors were left aside.

    Args:
        own: the architecture, if the file was exported by this project and states it.
        heads, names: as for :func:`infer_config`, whose errors it raises.

    Raises:
        ConvertError: in addition, if tensors are missing, unexpected, of the wrong shape or not finite.
    """
    config = own or infer_config(source, tensors, heads, names)
    used = {name: x for name, x in tensors.items() if name not in FIXED}
    shapes = jax.eval_shape(DiT(config).init_params, jax.random.key(0))
    return config, to_params(source, used, table(config), shapes, names), len(tensors) - len(used)


def to_public(config: Architecture, params: Params) -> Tensors:
    """Returns the tensors of a public file, including the fixed positions."""
    space = grid_positions(*config.grid, config.width)
    time = positions(config.frames, config.width)
    return {"pos_embed": space[None], "temp_embed": time[None]} | to_tensors(params, table(config))


def convert(source: Path, out: Path, weights: Literal["ema", "raw"], heads: int | None) -> list[str]:
    """Imports a public IRASim into a directory, or exports a directory's transformer to a safetensors file.

    Args:
        weights: which of the two networks in a public training checkpoint to import.

    Raises:
        UserError: the source cannot be read or does not fit, or ``out`` cannot be written.
    """
    if source.is_dir():
        replaces = check_file(out)
        config, params = load_irasim(source)
        tensors = to_public(config, params)
        write_safetensors(out, tensors, {METADATA: json.dumps(to_dict(config))})
        return [f"{out}: {len(tensors)} tensors of an IRASim, under their public names{replaces}"]
    holders: tuple[str, ...] = HOLDERS
    if weights == "ema":
        holders = ("ema", *HOLDERS)
    tensors, metadata, names, others, key = read_tensors(source, holders)
    lacking = ""
    if weights == "ema" and key != "ema":
        lacking = ", as it has no ema"
    own = exported_config(Architecture, source, metadata, METADATA)
    config, params, aside = from_public(source, tensors, own, heads, names)
    replaces = REPLACES * save(out, config, params)
    return [
        f"{out}: an IRASim of {len(tensors) - aside} tensors, {config}{replaces}",
        *([f"read from the file's key {key}{lacking}"] if key else []),
        *left_aside({"fixed positions, which the network computes": aside}, others),
    ]
