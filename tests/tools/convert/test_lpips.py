import numpy as np
import pytest

from rsjax.tools.convert.files import ConvertError, Tensors
from rsjax.tools.convert.lpips import from_public

ALEXNET = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3), 10: (256, 256, 3, 3)}
VGG16 = {
    index: (width, ins, 3, 3)
    for index, ins, width in zip(
        (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28),
        (3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512),
        (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512),
        strict=True,
    )
}
NETS = {"alexnet": (ALEXNET, (64, 192, 384, 256, 256)), "vgg16": (VGG16, (64, 128, 256, 512, 512))}


def zeros(*shape: int) -> np.ndarray:
    return np.broadcast_to(np.float32(0), shape)


def backbone(net: str, name: str = "features.{}") -> Tensors:
    convs, _ = NETS[net]
    weights = {f"{name.format(index)}.weight": zeros(*shape) for index, shape in convs.items()}
    return weights | {f"{name.format(index)}.bias": zeros(shape[0]) for index, shape in convs.items()}


def heads(net: str, prefix: str = "") -> Tensors:
    return {
        f"{prefix}lin{k}.model.1.weight": np.full((1, width, 1, 1), k, np.float32)
        for k, width in enumerate(NETS[net][1])
    }


def expected(net: str) -> set[str]:
    own = {f"backbone.{index}.{kind}" for index in NETS[net][0] for kind in ("weight", "bias")}
    return own | {f"head.{k}.weight" for k in range(5)}


@pytest.mark.parametrize("net", NETS)
def test_backbone_and_heads_are_merged(net: str) -> None:
    classifier = {"classifier.6.weight": zeros(1000, 4096), "classifier.6.bias": zeros(1000)}
    found, tensors = from_public("files", backbone(net) | classifier | heads(net))
    assert found == net
    assert tensors.keys() == expected(net)
    for k in range(5):
        assert np.all(tensors[f"head.{k}.weight"] == k)


def test_lpips_is_extracted_from_a_tokenizers_checkpoint() -> None:
    inside = "loss.perceptual_loss."
    rest = {
        f"{inside}scaling_layer.shift": zeros(1, 3, 1, 1),
        "encoder.conv_in.weight": zeros(32, 3, 3, 3),
        "model_ema.decay": zeros(),
        "loss.discriminator.main.0.weight": zeros(64, 3, 4, 4),
    }
    everything = backbone("vgg16", f"{inside}net.slice1.{{}}") | heads("vgg16", inside) | rest
    net, tensors = from_public("file", everything)
    assert (net, tensors.keys()) == ("vgg16", expected("vgg16"))


ALEX = backbone("alexnet") | heads("alexnet")
VGG = backbone("vgg16") | heads("vgg16")


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        (backbone("vgg16"), "file: only the backbone, vgg16; .*--heads-file"),
        ({name: x for name, x in VGG.items() if name != "lin3.model.1.weight"}, "missing: head.3.weight"),
        (backbone("vgg16") | heads("alexnet"), r"lin1.model.1.weight is \(1, 192, 1, 1\), not \(1, 128, 1, 1\)"),
        (heads("vgg16") | {"features.1.weight": zeros(96, 3, 7, 7)}, "are not those of alexnet or vgg16"),
        (ALEX | {"net.slice1.0.weight": zeros(64, 3, 11, 11)}, "backbone.0.weight occurs twice"),
        (ALEX | {"odd.weight": zeros(1)}, "unexpected: odd.weight"),
        (ALEX | {"lin3.model.1.weight": np.full((1, 256, 1, 1), np.nan)}, "NaN or infinite .*: lin3.model.1.weight"),
        (ALEX | {"lin3.model.1.weight": np.full((1, 256, 1, 1), 1j)}, "not floats: lin3.model.1.weight"),
    ],
)
def test_what_does_not_fit_is_named_as_in_the_file(tensors: Tensors, message: str) -> None:
    with pytest.raises(ConvertError, match=message):
        from_public("file", tensors)
