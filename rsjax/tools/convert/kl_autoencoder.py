"""Maps the names of ``diffusers``' AutoencoderKL, such as SDXL's, to the parameters of IRASim's autoencoder.

The ``config.json`` that is published beside the weights contains the scaling factor of the latents. The weights do not
reveal this factor: older autoencoders of the same shapes have another one.
"""

import math
import re
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.config import ConfigError
from rsjax.models.irasim.autoencoder import SDXL_FACTOR, init
from rsjax.models.irasim.config import KLConfig
from rsjax.progress import note
from rsjax.tools.convert.directory import load_kl_autoencoder, save
from rsjax.tools.convert.files import (
    REPLACES,
    SETTINGS,
    ConvertError,
    Tensors,
    check_file,
    check_type,
    left_aside,
    published_settings,
    setting,
    write_published,
)
from rsjax.tools.convert.sources import read_network, weights_files
from rsjax.tools.convert.table import SAME_NAMES, Names, Table, shape_of, to_params, to_tensors, vae_table
from rsjax.trainable import Params

CLASS = "AutoencoderKL"
# The names of the attention layers in older files.
OLDER = {"query": "to_q", "key": "to_k", "value": "to_v", "proj_attn": "to_out.0"}
_OLDER = re.compile(rf"(mid_block\.attentions\.0\.)({'|'.join(OLDER)})\.")


def name_table(config: KLConfig) -> Table:
    """Returns an entry for each public tensor.

    Raises:
        ConvertError: the network is not SDXL's, so it has no public names.
    """
    if config.network != "sdxl":
        raise ConvertError(f"the public format cannot express model.autoencoder.network {config.network!r}, only sdxl")
    return vae_table(_shapes(config), ((r"^encoder\.(quant_conv)", r"\1"), (r"^decoder\.(post_quant_conv)", r"\1")))


def _shapes(config: KLConfig) -> Params:
    """Returns the shapes of the networks' parameters, without the latents' statistics."""
    shapes = jax.eval_shape(lambda key: init(config, key), jax.random.key(0))
    return {name: shapes[name] for name in ("encoder", "decoder")}


def infer_config(source: object, tensors: Tensors, settings: dict[str, Any], names: Names = SAME_NAMES) -> KLConfig:
    """Infers the network from the shapes of its tensors, and from ``norm_num_groups`` of its settings.

    Raises:
        ConvertError: the tensors are not an AutoencoderKL's.
    """

    def width(key: str) -> int:
        return shape_of(source, tensors, f"{key}.weight", 4, names)[0]

    if not {"quant_conv.weight", "encoder.conv_in.weight", "encoder.down_blocks.0.resnets.0.conv1.weight"} <= set(
        tensors
    ):
        raise ConvertError(f"{source}: holds no {CLASS} of diffusers, such as SDXL's, with a tensor quant_conv.weight")
    channels = width("encoder.conv_in")
    z = width("post_quant_conv")
    first = re.compile(r"encoder\.down_blocks\.(\d+)\.resnets\.(\d+)\.conv1\.weight")
    places = [(int(match[1]), int(match[2])) for match in map(first.fullmatch, tensors) if match]
    levels, blocks = (max(column) + 1 for column in zip(*places, strict=True))
    try:
        return KLConfig(
            latent_channels=z,
            channels=channels,
            channel_multipliers=tuple(
                width(f"encoder.down_blocks.{level}.resnets.0.conv1") // channels for level in range(levels)
            ),
            res_blocks=blocks,
            norm_groups=setting(source, settings, "norm_num_groups", 32),
        )
    except ConfigError as error:
        raise ConvertError(f"{source}: the network inferred from its tensors cannot be built: {error}") from error


def from_public(
    source: object, tensors: Tensors, settings: dict[str, Any], names: Names = SAME_NAMES
) -> tuple[KLConfig, Params]:
    """Returns an autoencoder's settings and parameters, converted from a public file's tensors.

    Args:
        settings: the file's settings, from ``published_settings``; without them the latents' factor is SDXL's.
        names: the tensors' names in the file, where they differ, for error messages.

    Raises:
        ConvertError: as :func:`infer_config`; or tensors are missing, unexpected, of the wrong shape or not finite;
            or the settings are not numbers.
    """
    renamed: Tensors = {}
    in_file: dict[str, str] = {}
    for name, x in tensors.items():
        new = _OLDER.sub(lambda match: f"{match[1]}{OLDER[match[2]]}.", name)
        if ".attentions." in new and x.ndim == 4 and x.shape[2:] == (1, 1):
            x = x[..., 0, 0]  # some files store attention weights as 1×1 convolutions
        renamed[new] = x
        in_file[new] = names.get(name, name)
    tensors = renamed
    names = in_file
    config = infer_config(source, tensors, settings, names)
    factor = setting(source, settings, "scaling_factor", SDXL_FACTOR)
    shift = settings.get("shift_factor") or 0.0
    check_type(f"{source}: its {SETTINGS}", "shift_factor", shift, 0.0)
    if factor != SDXL_FACTOR:
        note(f"{source}: its latents have the factor {factor:g}; the public IRASim needs SDXL's, {SDXL_FACTOR:g}")
    fixed = {"mean": shift, "log_deviation": -math.log(factor)}
    params = to_params(source, tensors, name_table(config), _shapes(config), names)
    latents = {name: np.full(config.latent_channels, x, np.float32) for name, x in fixed.items()}
    return config, params | {"latents": latents}


def to_public(config: KLConfig, params: Params) -> tuple[Tensors, dict[str, Any]]:
    """Returns the tensors of a public file, and the settings to write beside it.

    Raises:
        ConvertError: the public format cannot express the network or its latents' statistics.
    """
    networks = {name: params[name] for name in ("encoder", "decoder")}
    tensors = to_tensors(networks, name_table(config))
    mean = np.asarray(params["latents"]["mean"])
    deviation = np.exp(params["latents"]["log_deviation"])
    if np.ptp(mean) > 0 or np.ptp(deviation) > 0:
        raise ConvertError(
            "the public format has one factor for all latent channels; this autoencoder has one for each"
        )
    return tensors, {
        "_class_name": CLASS,
        "block_out_channels": list(config.widths),
        "down_block_types": ["DownEncoderBlock2D"] * len(config.widths),
        "up_block_types": ["UpDecoderBlock2D"] * len(config.widths),
        "layers_per_block": config.res_blocks,
        "latent_channels": config.latent_channels,
        "norm_num_groups": config.norm_groups,
        "scaling_factor": round(float(1 / deviation[0]), 7),
        "shift_factor": float(mean[0]) or None,
    }


def convert(source: Path, out: Path) -> list[str]:
    """Imports SDXL's autoencoder into a directory.

    Args:
        source: the file, its directory, or that of a pipeline whose folder ``vae`` holds it.

    Raises:
        UserError: the source cannot be read or does not fit, or ``out`` cannot be written.
    """
    (source,) = weights_files(source, {"tokenizer": "vae"}, None)
    tensors, _, names, others, _ = read_network(source)
    settings = published_settings(source, CLASS)
    config, params = from_public(source, tensors, settings, names)
    replaces = REPLACES * save(out, config, params)
    lines = [f"{out}: an autoencoder of {len(tensors)} tensors, {config}{replaces}", *left_aside(others)]
    if "scaling_factor" not in settings:
        known = SDXL_FACTOR
        lines.append(f"no scaling_factor in a {SETTINGS} beside {source.name}: SDXL's {known} is taken")
    return lines


def export(source: Path, out: Path) -> list[str]:
    """Exports a directory's autoencoder to a safetensors file. Errors as in :func:`convert`."""
    replaces = check_file(out)
    tensors, settings = to_public(*load_kl_autoencoder(source))
    write_published(out, tensors, settings)
    text = f"under their public names; settings in {SETTINGS}{replaces}"
    return [f"{out}: {len(tensors)} tensors of an autoencoder, {text}"]
