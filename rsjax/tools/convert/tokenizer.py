"""Maps the names of Open-MAGVIT2's tokenizer: both generations, raw weights or their moving average.

A public file holds ``encoder.*`` and ``decoder.*``, their exponential moving average under ``model_ema.`` (with the
dots removed from the names), and the networks of the training losses.
"""

import json
from collections import Counter
from pathlib import Path
from typing import Any, Literal

import jax

from rsjax.config import ConfigError, TokenizerConfig, to_dict
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tools.convert.directory import load_tokenizer, save
from rsjax.tools.convert.files import (
    REPLACES,
    ConvertError,
    Tensors,
    check_file,
    exported_config,
    left_aside,
    write_safetensors,
)
from rsjax.tools.convert.sources import read_network, weights_file
from rsjax.tools.convert.table import SAME_NAMES, Entry, Names, norm, shape_of, to_params, to_tensors, weight_and_bias

Weights = Literal["raw", "ema"]
METADATA = "rsjax.tokenizer"  # key of the configuration in the metadata of an exported file
# Prefixes of the tensors to ignore.
IGNORED: dict[Weights, tuple[str, ...]] = {
    "raw": ("loss.", "model_ema."),
    "ema": ("loss.", "encoder.", "decoder.", "model_ema.loss", "model_ema.decay", "model_ema.num_updates"),
}


def public_name(key: str, weights: Weights) -> str:
    """Returns a public file's name for a key of the table."""
    if weights == "raw":
        return key
    return f"model_ema.{key.replace('.', '')}"


def name_table(config: TokenizerConfig) -> tuple[Entry, ...]:
    """Returns an entry for each public tensor of the network, under its raw name."""
    levels = range(len(config.channel_multipliers))
    widths = [config.channels * multiplier for multiplier in config.channel_multipliers]
    entries: list[Entry] = [Entry("encoder.conv_in.weight", "encoder/conv_in/kernel", "conv")]
    width = config.channels
    for level in levels:
        place = f"encoder.down.{level}"
        entries += _blocks(f"{place}.block", f"encoder/down_{level}_block", config.res_blocks, width, widths[level])
        width = widths[level]
        if level < levels[-1]:
            entries += weight_and_bias(f"{place}.downsample", f"encoder/down_{level}_downsample", "conv")
    for part in ("encoder", "decoder"):
        entries += _blocks(f"{part}.mid_block", f"{part}/mid_block", config.res_blocks, width, width)
        entries += norm(f"{part}.norm_out", f"{part}/norm_out")
        entries += weight_and_bias(f"{part}.conv_out", f"{part}/conv_out", "conv")
    entries += weight_and_bias("decoder.conv_in", "decoder/conv_in", "conv")
    for level in reversed(levels):
        place = f"decoder.up.{level}"
        if config.adaptive_norm:
            key = f"decoder.adaptive.{level}"
            path = f"decoder/adaptive_{level}"
            for name in ("gamma", "beta"):
                entries += weight_and_bias(f"{key}.{name}", f"{path}/{name}", "linear")
        entries += _blocks(f"{place}.block", f"decoder/up_{level}_block", config.res_blocks, width, widths[level])
        width = widths[level]
        if level > 0:
            entries += weight_and_bias(f"{place}.upsample.conv1", f"decoder/up_{level}_upsample", "conv")
    return tuple(entries)


def _blocks(key: str, path: str, count: int, width_in: int, width_out: int) -> list[Entry]:
    entries: list[Entry] = []
    for i in range(count):
        for k in (1, 2):
            entries += norm(f"{key}.{i}.norm{k}", f"{path}_{i}/norm{k}")
            entries.append(Entry(f"{key}.{i}.conv{k}.weight", f"{path}_{i}/conv{k}/kernel", "conv"))
        if i == 0 and width_in != width_out:
            entries.append(Entry(f"{key}.{i}.nin_shortcut.weight", f"{path}_{i}/nin_shortcut/kernel", "conv"))
    return entries


def infer_config(source: object, tensors: Tensors, weights: Weights, names: Names = SAME_NAMES) -> TokenizerConfig:
    """Infers the network from the names and shapes of its tensors.

    Raises:
        ConvertError: the tensors are not a tokenizer's, lack the moving average although ``weights`` is "ema", or
            belong to a network that this project cannot build.
    """

    def has(key: str) -> bool:
        return public_name(key, weights) in tensors

    def shape(key: str) -> tuple[int, ...]:
        return shape_of(source, tensors, public_name(key, weights), 4, names)

    def count(key: str) -> int:
        n = 0
        while has(key.format(n)):
            n += 1
        return n

    levels = count("encoder.down.{}.block.0.conv1.weight")
    blocks = count("encoder.down.0.block.{}.conv1.weight")
    if not (has("encoder.conv_in.weight") and has("encoder.conv_out.weight") and levels):
        if weights == "ema":
            kind = "averaged (ema) "
            cure = "; try --weights raw"
        else:
            kind = ""
            cure = ""
        raise ConvertError(
            f"{source}: holds no {kind}weights of a MAGVIT-2 tokenizer, such as "
            f"{public_name('encoder.conv_in.weight', weights)}{cure}"
        )
    (channels, colors) = shape("encoder.conv_in.weight")[:2]
    bits = shape("encoder.conv_out.weight")[0]
    patch = round((colors / 3) ** 0.5)
    widths = [shape(f"encoder.down.{level}.block.0.conv1.weight")[0] for level in range(levels)]
    try:
        return TokenizerConfig(
            patch_size=max(1, patch),
            channels=channels,
            channel_multipliers=tuple(max(1, width // channels) for width in widths),
            res_blocks=blocks,
            adaptive_norm=has("decoder.adaptive.0.gamma.weight"),
            local_codes=shape("encoder.conv_in.weight")[2] == 1,
            code_bits=bits,
            vocabularies=2 if bits % 2 == 0 else 1,
        )
    except ConfigError as error:
        raise ConvertError(f"{source}: the network inferred from its tensors cannot be built: {error}") from error


def from_public(
    source: object,
    tensors: Tensors,
    weights: Weights = "raw",
    config: TokenizerConfig | None = None,
    names: Names = SAME_NAMES,
) -> tuple[TokenizerConfig, Any, Counter[str]]:
    """Converts a public file's tensors to a tokenizer.

    Args:
        source: the file of the tensors, for error messages.
        weights: which weights to read: those of the last step ("raw"), or their moving average ("ema").
        config: the network; None infers it.
        names: the tensors' names in the file, where they differ, for error messages.

    Returns:
        The configuration, the parameters, and how many tensors were left aside, by the prefixes of their names.

    Raises:
        ConvertError: tensors are missing, unexpected, of the wrong shape, not finite, or not a tokenizer's.
    """
    config = config or infer_config(source, tensors, weights, names)
    entries = name_table(config)
    keys = {public_name(entry.key, weights): entry.key for entry in entries}
    kept: Tensors = {}
    aside: Counter[str] = Counter()
    for name, x in tensors.items():
        if name not in keys and name.startswith(IGNORED[weights]):
            aside[".".join(name.split(".")[: 2 if name.startswith("loss.") else 1])] += 1
        else:
            kept[keys.get(name, name)] = x
    shapes = jax.eval_shape(Tokenizer(config).init_params, jax.random.key(0))
    public = {own: names.get(key, key) for key, own in keys.items()}
    return config, to_params(source, kept, entries, shapes, dict(names) | public), aside


def convert(source: Path, out: Path, weights: Weights) -> list[str]:
    """Imports a public tokenizer into a directory.

    Raises:
        UserError: the source cannot be read or does not fit, or ``out`` cannot be written.
    """
    source = weights_file(source)
    tensors, metadata, names, others, _ = read_network(source)
    own = exported_config(TokenizerConfig, source, metadata, METADATA)
    config, params, aside = from_public(source, tensors, weights, own, names)
    replaces = REPLACES * save(out, config, params)
    used = len(tensors) - aside.total()
    return [f"{out}: a tokenizer of {used} {weights} tensors, {config}{replaces}", *left_aside(aside, others)]


def export(source: Path, out: Path) -> list[str]:
    """Exports a directory's tokenizer to a safetensors file. Errors as in :func:`convert`."""
    replaces = check_file(out)
    config, params = load_tokenizer(source)
    tensors = to_tensors(params, name_table(config))
    write_safetensors(out, tensors, {METADATA: json.dumps(to_dict(config))})
    return [f"{out}: {len(tensors)} tensors of a tokenizer, under their public names{replaces}"]
