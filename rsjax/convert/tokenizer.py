"""The MAGVIT-2 tokenizer's public names (Open-MAGVIT2), both generations, raw weights or their average.

A public file holds ``encoder.*`` and ``decoder.*``, their exponential average under ``model_ema.`` with the dots left
out of the names, and the training losses' networks.
"""

from dataclasses import dataclass
from typing import Any, Literal

import jax

from rsjax.config import TokenizerConfig
from rsjax.convert.files import ConvertError, Tensors
from rsjax.convert.table import Entry, Table, norm, to_params, weight_and_bias
from rsjax.tokenizers.magvit2 import Tokenizer

Weights = Literal["raw", "ema"]

CELLS = 16  # along each side of the public models' grids; weights do not tell the size of the images

# What a public file holds beside the wanted weights: names that begin so are left aside.
LEFT_ASIDE: dict[Weights, tuple[str, ...]] = {
    "raw": ("loss.", "model_ema."),
    "ema": ("loss.", "encoder.", "decoder.", "model_ema.loss", "model_ema.decay", "model_ema.num_updates"),
}


@dataclass(frozen=True)
class Converted:
    """A tokenizer out of a public file.

    Attributes:
        left_aside: how many tensors of each group were known but not wanted.
    """

    config: TokenizerConfig
    params: Any
    left_aside: dict[str, int]


def public_name(key: str, weights: Weights) -> str:
    """How the file spells a name of the table."""
    return key if weights == "raw" else f"model_ema.{key.replace('.', '')}"


def table(config: TokenizerConfig) -> Table:
    """Every public tensor of the network; raw names."""
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
            for name in ("gamma", "beta"):
                entries += weight_and_bias(
                    f"decoder.adaptive.{level}.{name}", f"decoder/adaptive_{level}/{name}", "linear"
                )
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


def infer_config(source: object, tensors: Tensors, weights: Weights) -> TokenizerConfig:
    """The network that these tensors are of, from names and shapes; images of 16×16 tokens are assumed.

    Raises:
        ConvertError: they are no tokenizer's, or hold no average where that is asked for.
        ConfigError: they are of a network that this project cannot build.
    """

    def get(key: str) -> Any:
        return tensors.get(public_name(key, weights))

    def count(key: str) -> int:
        n = 0
        while get(key.format(n)) is not None:
            n += 1
        return n

    ends = [get(key) for key in ("encoder.conv_in.weight", "encoder.conv_out.weight")]
    levels, blocks = count("encoder.down.{}.block.0.conv1.weight"), count("encoder.down.0.block.{}.conv1.weight")
    if any(x is None or x.ndim != 4 for x in ends) or not levels:
        kind = "averaged (ema) " if weights == "ema" else ""
        cure = "; its raw weights: --weights raw" if weights == "ema" else ""
        raise ConvertError(
            f"{source}: holds no {kind}weights of a MAGVIT-2 tokenizer, such as "
            f"{public_name('encoder.conv_in.weight', weights)}{cure}"
        )
    (channels, colors), bits = ends[0].shape[:2], ends[1].shape[0]
    patch = round((colors / 3) ** 0.5)
    return TokenizerConfig(
        image_size=CELLS * patch * 2 ** (levels - 1),
        patch_size=patch,
        channels=channels,
        channel_multipliers=tuple(
            get(f"encoder.down.{level}.block.0.conv1.weight").shape[0] // channels for level in range(levels)
        ),
        res_blocks=blocks,
        adaptive_norm=get("decoder.adaptive.0.gamma.weight") is not None,
        code_bits=bits,
        vocabularies=2 if bits % 2 == 0 else 1,
    )


def from_public(
    source: object, tensors: Tensors, weights: Weights = "raw", config: TokenizerConfig | None = None
) -> Converted:
    """A tokenizer from a public file's tensors.

    Args:
        source: where the tensors are from, for errors.
        weights: those of the last step, or their average.
        config: the network; inferred if not given.

    Raises:
        ConvertError: tensors are missing, left over or misshapen, or are no tokenizer's.
    """
    config = config or infer_config(source, tensors, weights)
    entries = table(config)
    spelled = {public_name(entry.key, weights): entry.key for entry in entries}
    kept: Tensors = {}
    aside: dict[str, int] = {}
    for name, x in tensors.items():
        if name not in spelled and name.startswith(LEFT_ASIDE[weights]):
            group = ".".join(name.split(".")[: 2 if name.startswith("loss.") else 1])
            aside[group] = aside.get(group, 0) + 1
        else:
            kept[spelled.get(name, name)] = x
    shapes = jax.eval_shape(Tokenizer(config).init_params, jax.random.key(0))
    return Converted(config, to_params(source, kept, entries, shapes), aside)
