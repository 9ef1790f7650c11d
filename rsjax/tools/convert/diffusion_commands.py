"""Converts checkpoints of diffusion models, for ``python -m experiments.convert``. Functions return lines to print."""

import json
from pathlib import Path
from typing import Literal

from rsjax.config import ConfigError, from_dict, to_dict
from rsjax.files import parse_json, read_json, write_json
from rsjax.models.irasim.dit import Architecture
from rsjax.tools.convert import directory, irasim, kl_autoencoder
from rsjax.tools.convert.commands import REPLACES, check_file
from rsjax.tools.convert.files import (
    HOLDERS,
    ConvertError,
    left_aside,
    published_settings,
    read_tensors,
    write_safetensors,
)

METADATA = "rsjax.irasim"  # key of the architecture in the metadata of an exported transformer


def convert_irasim(source: Path, out: Path, weights: Literal["ema", "raw"], heads: int | None) -> list[str]:
    """Imports a public IRASim into a directory, or exports a directory's transformer to a safetensors file.

    Args:
        weights: which of the two networks in a public training checkpoint to import.

    Raises:
        UserError: the source cannot be read or does not fit, or ``out`` cannot be written.
    """
    if source.is_dir():
        replaces = check_file(out)
        config, params = directory.load_irasim(source)
        tensors = irasim.to_public(config, params)
        write_safetensors(out, tensors, {METADATA: json.dumps(to_dict(config))})
        return [f"{out}: {len(tensors)} tensors of an IRASim, under their public names{replaces}"]
    holders = ("ema", *HOLDERS) if weights == "ema" else HOLDERS
    tensors, metadata, names, others, key = read_tensors(source, holders)
    lacking = ", as it has no ema" if weights == "ema" and key != "ema" else ""
    own = _exported(source, metadata)
    config, params, aside = irasim.from_public(source, tensors, own, heads, names)
    replaces = REPLACES * directory.save(out, config, params)
    return [
        f"{out}: an IRASim of {len(tensors) - aside} tensors, {config}{replaces}",
        *([f"read from the file's key {key}{lacking}"] if key else []),
        *left_aside({"fixed positions, which the network computes": aside}, others),
    ]


def convert_sdxl(source: Path, out: Path) -> list[str]:
    """Imports SDXL's autoencoder into a directory, or exports a directory's autoencoder to a safetensors file.

    Raises:
        UserError: as :func:`convert_irasim`.
    """
    if source.is_dir():
        replaces = check_file(out)
        tensors, settings = kl_autoencoder.to_public(*directory.load_kl_autoencoder(source))
        beside, cure = out.parent / kl_autoencoder.CONFIG, "write to an empty directory"
        if beside.exists() and read_json(beside, cure=cure) != settings:
            raise ConvertError(f"{beside}: exists with other settings; {cure}")
        write_safetensors(out, tensors, {})
        write_json(beside, settings)
        text = f"under their public names; settings in {kl_autoencoder.CONFIG}{replaces}"
        return [f"{out}: {len(tensors)} tensors of an autoencoder, {text}"]
    tensors, _, names, others, _ = read_tensors(source)
    settings = published_settings(source, kl_autoencoder.CLASS)
    config, params = kl_autoencoder.from_public(source, tensors, settings, names)
    replaces = REPLACES * directory.save(out, config, params)
    lines = [f"{out}: an autoencoder of {len(tensors)} tensors, {config}{replaces}", *left_aside(others)]
    if "scaling_factor" not in settings:
        known = kl_autoencoder.SDXL_FACTOR
        lines.append(f"no scaling_factor in a {kl_autoencoder.CONFIG} beside {source.name}: SDXL's {known} is taken")
    return lines


def _exported(source: Path, metadata: dict[str, str]) -> Architecture | None:
    if METADATA not in metadata:
        return None
    try:
        return from_dict(Architecture, parse_json(metadata[METADATA]))
    except (ValueError, TypeError, ConfigError) as error:
        raise ConvertError(f"{source}: its metadata {METADATA} are of another version or damaged ({error})") from error
