"""What ``python -m rsjax.convert`` does: one function per kind of checkpoint, each giving lines to print."""

import json
from pathlib import Path
from typing import Any

from rsjax.config import ConfigError, ModelConfig, TokenizerConfig, from_dict, to_dict
from rsjax.convert import genie, lpips, tokenizer
from rsjax.convert.files import SAFE, ConvertError, Tensors, read_tensors, write_safetensors
from rsjax.convert.table import to_tensors
from rsjax.files import disk_guard, write_atomically
from rsjax.training.pretrained import load_part, save_part

METADATA = "rsjax.tokenizers"  # the configuration in the metadata of a tokenizer that was written here


def convert_tokenizer(source: Path, out: Path, weights: tokenizer.Weights) -> list[str]:
    """A public tokenizer into a directory, or a directory's tokenizer into a safetensors file with public names.

    Raises:
        UserError: the source cannot be read or does not fit, or the place cannot be written.
    """
    if source.is_dir():
        _need_safetensors(out)
        config, params = load_part(source, TokenizerConfig)
        tensors = to_tensors(params, tokenizer.table(config))
        write_safetensors(out, tensors, {METADATA: json.dumps(to_dict(config))})
        return [f"{out}: {len(tensors)} tensors of a tokenizer, under their public names"]
    tensors, metadata = read_tensors(source)
    made_here = _metadata_config(source, metadata)
    converted = tokenizer.from_public(source, tensors, weights, made_here)
    save_part(out, converted.config, converted.params)
    used = len(tokenizer.table(converted.config))
    aside = [f"left aside: {count} tensors of {group}" for group, count in sorted(converted.left_aside.items())]
    return [f"{out}: a tokenizer out of {used} {weights} tensors, {converted.config}", *aside]


def convert_genie(source: Path, out: Path, heads: int | None) -> list[str]:
    """A public Genie into a directory, or a directory's model into a safetensors file with public names.

    Raises:
        UserError: as :func:`convert_tokenizer`.
    """
    if source.is_dir():
        _need_safetensors(out)
        config, params = load_part(source, ModelConfig)
        tensors = to_tensors(params, genie.table(config))
        _write_settings(out.parent / genie.CONFIG, genie.settings_of(config))
        write_safetensors(out, tensors, {})
        return [f"{out}: {len(tensors)} tensors of a Genie, under their public names; settings in {genie.CONFIG}"]
    tensors, _ = read_tensors(source)
    settings = genie.read_settings(source)
    config, params = genie.from_public(source, tensors, settings, heads)
    save_part(out, config, params)
    lines = [f"{out}: a world model out of {len(tensors)} tensors, {config}"]
    if settings.get("use_mup") is None:
        lines.append(f"no use_mup in a {genie.CONFIG} beside {source.name}: taken for a model without muP")
    return lines


def convert_lpips(sources: list[Path], out: Path) -> list[str]:
    """LPIPS's backbone and heads, in one public file or two, into one file.

    Raises:
        UserError: as :func:`convert_tokenizer`.
    """
    _need_safetensors(out)
    names = ", ".join(map(str, sources))
    together: Tensors = {}
    for source in sources:
        tensors, _ = read_tensors(source)
        twice = together.keys() & tensors.keys()
        if twice:
            raise ConvertError(f"{source}: {min(twice)} stands in an earlier file too; give each part once")
        together |= tensors
    net, own = lpips.from_public(names, together)
    write_safetensors(out, own, {"net": net})
    return [f"{out}: LPIPS with {net}, {len(own)} tensors; {len(together) - len(own)} left aside"]


def _need_safetensors(out: Path) -> None:
    if out.suffix != SAFE:
        raise ConvertError(f"{out}: what is written here is a {SAFE} file; give OUT such a name")


def _metadata_config(source: Path, metadata: dict[str, str]) -> TokenizerConfig | None:
    if METADATA not in metadata:
        return None
    try:
        return from_dict(TokenizerConfig, json.loads(metadata[METADATA]))
    except (ValueError, TypeError, ConfigError) as error:
        raise ConvertError(f"{source}: its metadata {METADATA} is of another version or damaged ({error})") from error


def _write_settings(path: Path, settings: dict[str, Any]) -> None:
    text = json.dumps(settings, indent=1)
    if path.exists() and path.read_text() != text:
        raise ConvertError(f"{path}: is there already, with other settings; write to a directory of its own")
    with disk_guard(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text.encode())
