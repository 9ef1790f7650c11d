"""Converts one checkpoint of each kind, for ``python -m experiments.convert``. Each function returns lines to print."""

import json
from pathlib import Path

from rsjax.config import ConfigError, TokenizerConfig, from_dict, to_dict
from rsjax.files import parse_json, read_json, write_json
from rsjax.tools.convert import directory, genie, lpips, tokenizer
from rsjax.tools.convert.files import SAFE, ConvertError, Tensors, left_aside, read_tensors, write_safetensors
from rsjax.tools.convert.table import to_tensors

REPLACES = "; it replaces the one that was there"
METADATA = "rsjax.tokenizer"  # key of the configuration in the metadata of an exported tokenizer


def convert_tokenizer(source: Path, out: Path, weights: tokenizer.Weights) -> list[str]:
    """Imports a public tokenizer into a directory, or exports a directory's tokenizer to a safetensors file.

    Raises:
        UserError: the source cannot be read or does not fit, or ``out`` cannot be written.
    """
    if source.is_dir():
        replaces = check_file(out)
        config, params = directory.load_tokenizer(source)
        tensors = to_tensors(params, tokenizer.table(config))
        write_safetensors(out, tensors, {METADATA: json.dumps(to_dict(config))})
        return [f"{out}: {len(tensors)} tensors of a tokenizer, under their public names{replaces}"]
    tensors, metadata, names, others, _ = read_tensors(source)
    own = _exported_config(source, metadata)
    config, params, aside = tokenizer.from_public(source, tensors, weights, own, names)
    replaces = REPLACES * directory.save(out, config, params)
    used = len(tensors) - aside.total()
    return [f"{out}: a tokenizer of {used} {weights} tensors, {config}{replaces}", *left_aside(aside, others)]


def convert_genie(source: Path, out: Path, heads: int | None) -> list[str]:
    """Imports a public Genie into a directory, or exports a directory's world model to a safetensors file.

    Raises:
        UserError: as :func:`convert_tokenizer`.
    """
    if source.is_dir():
        replaces = check_file(out)
        config, params = directory.load_world_model(source)
        tensors = to_tensors(params, genie.table(config))
        beside, settings = out.parent / genie.CONFIG, genie.settings_of(config)
        cure = "write to an empty directory"
        if beside.exists() and read_json(beside, cure=cure) != settings:
            raise ConvertError(f"{beside}: exists with other settings; {cure}")
        write_safetensors(out, tensors, {})
        write_json(beside, settings)
        text = f"under their public names; settings in {genie.CONFIG}{replaces}"
        return [f"{out}: {len(tensors)} tensors of a Genie, {text}"]
    tensors, _, names, others, _ = read_tensors(source)
    settings = genie.read_settings(source)
    config, params = genie.from_public(source, tensors, settings, heads, names)
    replaces = REPLACES * directory.save(out, config, params)
    lines = [f"{out}: a world model of {len(tensors)} tensors, {config}{replaces}", *left_aside(others)]
    if settings.get("use_mup") is None:
        lines.append(f"no use_mup in a {genie.CONFIG} beside {source.name}: converted as a model without muP")
    return lines


def convert_lpips(sources: list[Path], out: Path) -> list[str]:
    """Converts LPIPS's backbone and heads from one or two public files to one file.

    Raises:
        UserError: as :func:`convert_tokenizer`.
    """
    replaces = check_file(out)
    merged: Tensors = {}
    names: dict[str, str] = {}
    aside = 0
    for source in sources:
        tensors, _, own, others, _ = read_tensors(source)
        if twice := merged.keys() & tensors.keys():
            raise ConvertError(f"{source}: {own[min(twice)]} is also in an earlier file; pass each part once")
        merged |= tensors
        names |= own
        aside += sum(others.values())
    net, weights = lpips.from_public(", ".join(map(str, sources)), merged, names)
    write_safetensors(out, weights, {"net": net})
    lines = left_aside({"other layers or networks": aside + len(merged) - len(weights)})
    return [f"{out}: LPIPS with {net}, {len(weights)} tensors{replaces}", *lines]


def check_file(out: Path) -> str:
    """Checks the name of the file to write; returns a note for the message if the file replaces another one."""
    if out.suffix != SAFE:
        raise ConvertError(f"{out}: the output is a {SAFE} file; name OUT accordingly")
    return REPLACES * out.exists()


def _exported_config(source: Path, metadata: dict[str, str]) -> TokenizerConfig | None:
    if METADATA not in metadata:
        return None
    try:
        return from_dict(TokenizerConfig, parse_json(metadata[METADATA]))
    except (ValueError, TypeError, ConfigError) as error:
        raise ConvertError(f"{source}: its metadata {METADATA} are of another version or damaged ({error})") from error
