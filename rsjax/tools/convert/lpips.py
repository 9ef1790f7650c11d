"""Converts public LPIPS weights to the one file that :func:`rsjax.tokenizers.lpips.load_lpips` reads.

The backbone is torchvision's AlexNet or VGG16; the heads are PerceptualSimilarity's. They may be in two files, in one
state dict, or inside a tokenizer's training checkpoint.
"""

import re
from collections.abc import Iterable
from pathlib import Path

from rsjax.files import sealed_metadata
from rsjax.tokenizers.lpips import NETS, lpips_shapes
from rsjax.tools.convert.files import ConvertError, Tensors, check_file, left_aside, write_safetensors
from rsjax.tools.convert.sources import read_network, weights_file
from rsjax.tools.convert.table import SAME_NAMES, Names, check

_WITHIN = r"(?:loss\.perceptual_loss\.)?"  # the prefix in a tokenizer's checkpoint
NAMES = (
    (re.compile(rf"{_WITHIN}(?:features|net\.slice\d)\.(\d+)\.(weight|bias)"), r"backbone.\1.\2"),
    (re.compile(rf"{_WITHIN}lin(\d)\.model\.1\.(weight)"), r"head.\1.\2"),
)
# Tensors to ignore: the classifier, the fixed scaling, the heads' second copy, and the rest of a tokenizer.
IGNORED = re.compile(
    rf"{_WITHIN}(classifier|scaling_layer|lins)\..*|(encoder|decoder|model_ema|loss\.discriminator)\..*"
)


def from_public(source: object, tensors: Tensors, names: Names = SAME_NAMES) -> tuple[str, Tensors]:
    """Returns the network's name and its weights, named as in the project's file.

    Args:
        source: the files of the tensors, for error messages.
        tensors: the tensors of all files together.
        names: the tensors' names in the files, where they differ, for error messages.

    Raises:
        ConvertError: the network is unknown; or tensors are missing, unexpected, of the wrong shape or not finite.
    """
    weights: Tensors = {}
    public: dict[str, str] = {}
    for name, x in tensors.items():
        own = next((pattern.sub(to, name) for pattern, to in NAMES if pattern.fullmatch(name)), None)
        if own is not None and own in weights:
            second = names.get(name, name)
            raise ConvertError(f"{source}: {own} occurs twice, as {public[own]} and as {second}; pass each part once")
        if own is not None or not IGNORED.fullmatch(name):
            weights[own or name] = x
            public[own or name] = names.get(name, name)
    nets = [net for net in NETS if _backbone(lpips_shapes(net)) == _backbone(weights)]
    if not nets:
        raise ConvertError(
            f"{source}: the convolutions features.{{i}} are not those of {' or '.join(NETS)}; "
            f"pass torchvision's weights, and the heads with --heads-file"
        )
    if not any(name.startswith("head.") for name in weights):
        raise ConvertError(f"{source}: only the backbone, {nets[0]}; pass the published heads with --heads-file")
    check(source, weights, lpips_shapes(nets[0]), public)
    return nets[0], weights


def _backbone(names: Iterable[str]) -> set[str]:
    return {name for name in names if name.startswith("backbone.")}


def convert(sources: list[Path], out: Path) -> list[str]:
    """Converts LPIPS's backbone and heads from one or two public files to one file.

    Raises:
        UserError: the files cannot be read or do not fit, or ``out`` cannot be written.
    """
    replaces = check_file(out)
    merged: Tensors = {}
    names: dict[str, str] = {}
    aside = 0
    for source in map(weights_file, sources):
        tensors, _, own, others, _ = read_network(source)
        if twice := merged.keys() & tensors.keys():
            raise ConvertError(f"{source}: {own[min(twice)]} is also in an earlier file; pass each part once")
        merged |= tensors
        names |= own
        aside += sum(others.values())
    net, weights = from_public(", ".join(map(str, sources)), merged, names)
    write_safetensors(out, weights, sealed_metadata(weights, {"net": net}))
    lines = left_aside({"other layers or networks": aside + len(merged) - len(weights)})
    return [f"{out}: LPIPS with {net}, {len(weights)} tensors{replaces}", *lines]
