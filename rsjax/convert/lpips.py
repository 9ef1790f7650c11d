"""LPIPS weights out of public files into the one file that :func:`rsjax.tokenizers.lpips.load_lpips` reads.

The backbone is torchvision's AlexNet or VGG16, the heads are PerceptualSimilarity's. Each of these may hold them: one
file each, one state dict of the whole, or a tokenizer's training checkpoint.
"""

import re
from collections.abc import Iterable

from rsjax.convert.files import ConvertError, Tensors
from rsjax.convert.table import check
from rsjax.tokenizers.lpips import NETS, lpips_shapes

_WITHIN = r"(?:loss\.perceptual_loss\.)?"  # where a tokenizer's checkpoint holds it
NAMES = (
    (re.compile(rf"{_WITHIN}(?:features|net\.slice\d)\.(\d+)\.(weight|bias)"), r"backbone.\1.\2"),
    (re.compile(rf"{_WITHIN}lin(\d)\.model\.1\.(weight)"), r"head.\1.\2"),
)
# Known but not wanted: the classifier, the fixed scaling, the heads' second copy, and the rest of a tokenizer.
LEFT_ASIDE = re.compile(
    rf"{_WITHIN}(classifier|scaling_layer|lins)\..*|(encoder|decoder|model_ema|loss\.discriminator)\..*"
)


def from_public(source: object, tensors: Tensors) -> tuple[str, Tensors]:
    """The network's name and its weights, named as in the project's file.

    Args:
        source: where the tensors are from, for errors.
        tensors: of all public files together.

    Raises:
        ConvertError: the network is unknown; or tensors are missing, left over or misshapen.
    """
    found: Tensors = {}
    for name, x in tensors.items():
        own = next((pattern.sub(to, name) for pattern, to in NAMES if pattern.fullmatch(name)), None)
        if own is not None and own in found:
            raise ConvertError(f"{source}: {own} is there twice, the second time as {name}; give each part once")
        if own is not None or not LEFT_ASIDE.fullmatch(name):
            found[own or name] = x
    nets = [net for net in NETS if _backbone(lpips_shapes(net)) == _backbone(found)]
    if not nets:
        raise ConvertError(
            f"{source}: convolutions features.{{i}} of no network that LPIPS uses ({', '.join(NETS)}); "
            f"give torchvision's weights, and the heads with --heads-file"
        )
    if not any(name.startswith("head.") for name in found):
        raise ConvertError(f"{source}: the backbone alone, {nets[0]}; give the published heads with --heads-file")
    check(source, {name: x.shape for name, x in found.items()}, lpips_shapes(nets[0]))
    return nets[0], found


def _backbone(names: Iterable[str]) -> set[str]:
    return {name for name in names if name.startswith("backbone.")}
