"""Maps the names of the public IRASim checkpoints to the transformer's parameters.

The weights' shapes reveal neither the number of heads, nor whether the last layer of Frame-Ada sees the actions. The
file's fixed positions identify the token grid of a frame and are then left aside: the network computes its own.
"""

import json
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import numpy as np

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
    write_safetensors,
)
from rsjax.tools.convert.sources import read_network, weights_file
from rsjax.tools.convert.table import SAME_NAMES, Entry, Names, Table, shape_of, to_params, to_tensors, weight_and_bias
from rsjax.trainable import Params

METADATA = "rsjax.irasim"  # key of the architecture in the metadata of an exported file
FIXED = ("pos_embed", "temp_embed")
HEADS = {1152: 16, 1024: 16, 768: 12, 384: 6}  # attention heads of the public sizes, by width
PUBLIC_VIDEO = (15 * 7, 16)  # numbers that the public Video-Ada reads, and its frames
ROUNDING = 1e-6  # of positions, whose neighbours differ by far more

Conditioning = Literal["frame", "video"]


class Variant(NamedTuple):
    """The settings that a file's tensors do not reveal.

    Attributes:
        heads: attention heads; None: those of the public sizes.
        conditioning: of one action at a time or of a whole clip, where the shapes allow both.
        final_frame_ada: whether the last layer of Frame-Ada sees the actions, which no shape shows.
    """

    heads: int | None = None
    conditioning: Conditioning | None = None
    final_frame_ada: bool = False


VARIANT = Variant()


def name_table(config: Architecture) -> Table:
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
    if config.clip_mlp:
        entries += [
            *weight_and_bias("mlp.fc1", "clip_fc1", "linear"),
            *weight_and_bias("mlp.fc2", "clip_fc2", "linear"),
        ]
    parts = {"attn.qkv": "qkv", "attn.proj": "proj", "mlp.fc1": "fc1", "mlp.fc2": "fc2", "adaLN_modulation.1": "ada"}
    for i in range(config.blocks):
        path = f"blocks/{('spatial', 'temporal')[i % 2]}"
        for public, own in parts.items():
            entries += weight_and_bias(f"blocks.{i}.{public}", f"{path}/{own}", "linear", i // 2)
    return tuple(entries)


def infer_config(
    source: object, tensors: Tensors, variant: Variant = VARIANT, names: Names = SAME_NAMES
) -> Architecture:
    """Infers the network from its tensors.

    Args:
        variant: what the tensors do not reveal.
        names: the tensors' names in the file, where they differ, for error messages.

    Raises:
        ConvertError: the tensors are not an IRASim's; they leave the number of heads or the way of conditioning
            unknown; or the positions are those of no grid.
    """

    def shape(key: str, axes: int) -> tuple[int, ...]:
        return shape_of(source, tensors, key, axes, names)

    if not {"mask_emb_fn.weight", "x_embedder.proj.weight"} <= tensors.keys():
        raise ConvertError(f"{source}: holds no weights of an IRASim, such as mask_emb_fn.weight")
    width, channels, patch, _ = shape("x_embedder.proj.weight", 4)
    (_, frames, _) = shape("temp_embed", 3)
    linear = "embed_arm_state.weight" in tensors
    inputs = shape("embed_arm_state.weight" if linear else "embed_state.fc1.weight", 2)[1]
    if linear:
        conditioning: Conditioning = "video" if "mlp.fc1.weight" in tensors else "frame"
    else:
        conditioning = _conditioning(source, inputs, frames, variant.conditioning)
        if conditioning == "video":
            inputs = inputs // (frames - 1)
    heads = variant.heads or HEADS.get(width)
    if heads is None:
        raise ConvertError(f"{source}: of width {width}, which is not a public size; set --heads")
    rows, columns = _grid(source, tensors, names)
    try:
        return Architecture(
            conditioning=conditioning,
            action_activation="none" if linear else "gelu",
            final_frame_ada=variant.final_frame_ada,
            learn_sigma=shape("final_layer.linear.weight", 2)[0] == 2 * patch**2 * channels,
            width=width,
            blocks=sum(name.startswith("blocks.") and name.endswith(".attn.qkv.weight") for name in tensors),
            heads=heads,
            mlp_ratio=max(1, shape("blocks.0.mlp.fc1.weight", 2)[0] // width),
            patch_size=patch,
            frames=frames,
            rows=rows * patch,
            columns=columns * patch,
            channels=channels,
            action_inputs=inputs,
        )
    except ConfigError as error:
        raise ConvertError(f"{source}: the network inferred from its tensors cannot be built: {error}") from error


def _conditioning(source: object, inputs: int, frames: int, chosen: Conditioning | None) -> Conditioning:
    """Returns whether an encoder of this many inputs reads one action at a time, or all frames - 1 of a clip."""
    if frames < 2 or inputs % (frames - 1):
        if chosen == "video":
            raise ConvertError(
                f"{source}: reads {inputs} numbers, which the {frames - 1} actions of a clip do not divide; leave out "
                f"--conditioning video"
            )
        return "frame"
    if chosen is None and (inputs, frames) != PUBLIC_VIDEO:
        raise ConvertError(
            f"{source}: reads {inputs} numbers, which are one action or those of all {frames - 1} in a clip; set "
            f"--conditioning frame or --conditioning video"
        )
    return chosen or "video"


def _grid(source: object, tensors: Tensors, names: Names) -> tuple[int, int]:
    """Returns rows and columns of the tokens whose fixed positions a file holds.

    Raises:
        ConvertError: no grid, or no clip, has these positions.
    """
    _, cells, width = shape_of(source, tensors, "pos_embed", 3, names)
    _, frames, _ = shape_of(source, tensors, "temp_embed", 3, names)
    time = tensors["temp_embed"][0]
    grids = [(rows, cells // rows) for rows in range(1, cells + 1) if cells % rows == 0]
    fitting = [grid for grid in grids if _near(tensors["pos_embed"][0], grid_positions(*grid, width))]
    for name, fits in (("pos_embed", bool(fitting)), ("temp_embed", _near(time, positions(frames, time.shape[-1])))):
        if not fits:
            known = names.get(name, name)
            raise ConvertError(
                f"{source}: {known} holds no sines and cosines of the positions of {tensors[name].shape[1]} "
                f"{'cells in rows and columns' if name == 'pos_embed' else 'frames'}, as the public files do"
            )
    return fitting[0]


def _near(x: np.ndarray, y: np.ndarray) -> bool:
    return x.shape == y.shape and np.allclose(x.astype(np.float32), y, rtol=0, atol=ROUNDING)


def from_public(
    source: object,
    tensors: Tensors,
    own: Architecture | None = None,
    variant: Variant = VARIANT,
    names: Names = SAME_NAMES,
) -> tuple[Architecture, Params, int]:
    """Returns a model's architecture, its parameters and how many tensors were left aside.

    Args:
        own: the architecture, if the file was exported by this project and states it.
        variant, names: as for :func:`infer_config`, whose errors it raises.

    Raises:
        ConvertError: in addition, if tensors are missing, unexpected, of the wrong shape or not finite.
    """
    config = own or infer_config(source, tensors, variant, names)
    used = {name: x for name, x in tensors.items() if name not in FIXED}
    shapes = jax.eval_shape(DiT(config).init_params, jax.random.key(0))
    return config, to_params(source, used, name_table(config), shapes, names), len(tensors) - len(used)


def to_public(config: Architecture, params: Params) -> Tensors:
    """Returns the tensors of a public file, including the fixed positions."""
    space = grid_positions(*config.grid, config.width)
    time = positions(config.frames, config.width)
    return {"pos_embed": space[None], "temp_embed": time[None]} | to_tensors(params, name_table(config))


def convert(source: Path, out: Path, weights: Literal["ema", "raw"], variant: Variant = VARIANT) -> list[str]:
    """Imports a public IRASim into a directory.

    Args:
        weights: which of the two networks in a public training checkpoint to import.
        variant: what a public file's tensors do not reveal.

    Raises:
        UserError: the source cannot be read or does not fit, or ``out`` cannot be written.
    """
    source = weights_file(source)
    holders: tuple[str, ...] = HOLDERS
    if weights == "ema":
        holders = ("ema", *HOLDERS)
    tensors, metadata, names, others, key = read_network(source, holders)
    lacking = ""
    if weights == "ema" and key != "ema":
        lacking = ", as it has no ema"
    own = exported_config(Architecture, source, metadata, METADATA)
    config, params, aside = from_public(source, tensors, own, variant, names)
    replaces = REPLACES * save(out, config, params)
    return [
        f"{out}: an IRASim of {len(tensors) - aside} tensors, {config}{replaces}",
        *([f"read from the file's key {key}{lacking}"] if key else []),
        *left_aside({"fixed positions, which the network computes": aside}, others),
    ]


def export(source: Path, out: Path) -> list[str]:
    """Exports a directory's transformer to a safetensors file. Errors as in :func:`convert`."""
    replaces = check_file(out)
    config, params = load_irasim(source)
    if config.depth:
        raise ConvertError(f"{source}: its network has channels of depth, which the public format does not know")
    tensors = to_public(config, params)
    write_safetensors(out, tensors, {METADATA: json.dumps(to_dict(config))})
    return [f"{out}: {len(tensors)} tensors of an IRASim, under their public names{replaces}"]
