import math
from dataclasses import replace

import jax
import numpy as np
import pytest

from rsjax.config import TokenizerConfig
from rsjax.tokenizers import lfq
from rsjax.tokenizers.magvit2 import Tokenizer, to_unit
from rsjax.tools.convert.files import ConvertError
from rsjax.tools.convert.table import public_shapes, to_tensors
from rsjax.tools.convert.tokenizer import Weights, from_public, infer_config, name_table, public_name
from tests.tools.convert.public import Tensors, TokenizerNet, random_tensors, tokenizer_shapes

MULT = (1, 1, 2)
BITS = 6
GENERATIONS = {"older": (1, False), "newer": (2, True)}


def tensors(generation: str, seed: int = 0) -> Tensors:
    res, adaptive = GENERATIONS[generation]
    return random_tensors(tokenizer_shapes(32, MULT, res, BITS, adaptive), seed)


def training_file(generation: str) -> tuple[Tensors, Tensors, Tensors]:
    """Returns a whole training checkpoint, its raw weights and their moving average."""
    raw = tensors(generation, 0)
    ema = tensors(generation, 1)
    rest = {
        "loss.discriminator.main.0.weight": (64, 3, 4, 4),
        "loss.discriminator.main.3.num_batches_tracked": (),
        "loss.perceptual_loss.net.slice1.0.weight": (64, 3, 3, 3),
        "model_ema.decay": (),
        "model_ema.num_updates": (),
        "model_ema.lossdiscriminatormain0weight": (64, 3, 4, 4),
    }
    spelled = {f"model_ema.{name.replace('.', '')}": x for name, x in ema.items()}
    return raw | spelled | random_tensors(rest), raw, ema


def equal(left: Tensors, right: Tensors) -> bool:
    return left.keys() == right.keys() and all(
        left[name].dtype == right[name].dtype and np.array_equal(left[name], right[name]) for name in left
    )


@pytest.mark.parametrize(
    ("res", "adaptive", "encoder", "decoder"),
    [(2, False, (87, 24_964_498), (88, 40_526_211)), (4, True, (159, 49_751_442), (180, 65_376_387))],
    ids=["256_B", "256_L"],
)
def test_both_published_sizes_have_the_published_names_and_shapes(
    res: int, adaptive: bool, encoder: tuple[int, int], decoder: tuple[int, int]
) -> None:
    config = TokenizerConfig(res_blocks=res, adaptive_norm=adaptive)
    shapes = public_shapes(name_table(config), jax.eval_shape(Tokenizer(config).init_params, jax.random.key(0)))
    assert shapes == tokenizer_shapes(128, (1, 1, 2, 2, 4), res, 18, adaptive)
    for part, published in (("encoder", encoder), ("decoder", decoder)):
        sizes = [math.prod(shape) for name, shape in shapes.items() if name.startswith(part)]
        assert (len(sizes), sum(sizes)) == published
    assert shapes["decoder.up.4.upsample.conv1.weight"] == (2048, 512, 3, 3)
    inferred = infer_config("file", {name: np.broadcast_to(np.float32(0), s) for name, s in shapes.items()}, "raw")
    assert inferred == config


@pytest.mark.parametrize("generation", GENERATIONS)
def test_the_converted_tokenizer_computes_what_the_published_one_does(generation: str) -> None:
    public = tensors(generation)
    config, params, _ = from_public("file", public)
    net = TokenizerNet(public, len(MULT), config.res_blocks)
    pixels = np.random.default_rng(0).integers(0, 256, (2, 16, 12, 3), np.uint8)
    images, latents = jax.jit(Tokenizer(config).apply)({"params": params}, to_unit(pixels))
    expected = net.encode(pixels.transpose(0, 3, 1, 2) / 127.5 - 1)
    np.testing.assert_allclose(latents, expected.transpose(0, 2, 3, 1), rtol=2e-4, atol=2e-4)
    decoded = net.decode(np.where(expected > 0, 1.0, -1.0)).transpose(0, 2, 3, 1)
    np.testing.assert_allclose(images, decoded, rtol=1e-3, atol=1e-3)
    assert decoded.std() > 0.1
    # Bit c of a token is the sign of channel c: little-endian.
    tokens = sum((expected[:, c] > 0) * 2**c for c in range(BITS))
    np.testing.assert_array_equal(lfq.codes_to_tokens(latents), tokens)
    assert len(np.unique(tokens)) > 4


@pytest.mark.parametrize(("generation", "weights"), [("older", "raw"), ("newer", "ema")])
def test_a_training_checkpoint_yields_the_chosen_weights_and_counts_the_rest(generation: str, weights: Weights) -> None:
    everything, raw, ema = training_file(generation)
    config, params, ignored = from_public("file", everything, weights)
    wanted = {"raw": raw, "ema": ema}[weights]
    assert equal(to_tensors(params, name_table(config)), wanted)
    assert ignored["loss.discriminator"] == 2
    assert ignored["loss.perceptual_loss"] == 1
    assert ignored.total() == len(everything) - len(wanted)


def test_a_tokenizer_with_local_codes_comes_back() -> None:
    config = TokenizerConfig(4, 32, (1, 2), 1, local_codes=True)
    shapes = jax.eval_shape(Tokenizer(config).init_params, jax.random.key(0))
    written = random_tensors(public_shapes(name_table(config), shapes))
    inferred, read, _ = from_public("file", written)
    assert inferred == config
    assert equal(to_tensors(read, name_table(config)), written)


def test_half_precision_is_widened_exactly() -> None:
    half = {name: x.astype(np.float16) for name, x in tensors("older").items()}
    config, params, _ = from_public("file", half)
    assert equal(to_tensors(params, name_table(config)), {name: x.astype(np.float32) for name, x in half.items()})


def test_all_misfits_are_named_in_one_error() -> None:
    everything, _, _ = training_file("older")
    missing = public_name("decoder.norm_out.bias", "ema")
    extra = public_name("decoder.extra.weight", "ema")
    wrong = public_name("encoder.mid_block.0.conv1.weight", "ema")
    del everything[missing]
    everything[extra] = np.zeros(3, np.float32)
    everything[wrong] = np.zeros((64, 64, 1, 1), np.float32)
    with pytest.raises(ConvertError) as caught:
        from_public("some.ckpt", everything, "ema")
    message = str(caught.value)
    assert message.startswith("some.ckpt: ")
    assert f"missing: {missing}" in message
    assert f"unexpected: {extra}" in message
    assert f"of another shape: {wrong} is (64, 64, 1, 1), not (64, 64, 3, 3)" in message


def test_a_configuration_overrides_inference() -> None:
    public = tensors("older")
    config = replace(infer_config("file", public, "raw"), norm_groups=8, depth_scale="linear")
    assert from_public("file", public, config=config)[0] == config


@pytest.mark.parametrize(
    ("weights", "key", "value", "message"),
    [
        ("raw", "encoder.conv_in.weight", np.zeros(()), "module.{} is"),
        ("ema", "encoder.conv_in.weight", np.zeros((4, 0, 3, 3)), "module.{} is"),
        ("raw", "encoder.conv_in.weight", np.zeros((33, 3, 3, 3)), "cannot be built"),
        ("raw", "encoder.down.1.block.0.conv1.weight", np.zeros((33, 3, 3, 3)), "module.{} is"),
        ("ema", "encoder.conv_out.weight", np.zeros((32, 3)), "module.{} is"),
        ("ema", "decoder.norm_out.bias", np.full(32, np.nan), "NaN or infinite values: module.{}"),
        ("raw", "decoder.norm_out.bias", np.full(32, 3), "not floats: module.{}"),
        ("raw", "decoder.norm_out.bias", np.full(32, 1j), "not floats: module.{}"),
    ],
)
def test_weights_that_do_not_fit_are_named_as_in_the_file(
    weights: Weights, key: str, value: np.ndarray, message: str
) -> None:
    name = public_name(key, weights)
    everything = training_file("older")[0] | {name: value}
    with pytest.raises(ConvertError, match=rf"^some\.ckpt: .*({message.format(name)})"):
        from_public("some.ckpt", everything, weights, names={name: f"module.{name}" for name in everything})


@pytest.mark.parametrize(
    ("tensors", "weights", "message"),
    [
        (tensors("older"), "ema", "no averaged.*--weights raw"),
        ({}, "raw", "no weights of a MAGVIT-2 tokenizer"),
        ({"encoder.conv_in.weight": np.zeros((4, 3))}, "raw", "no weights of a MAGVIT-2 tokenizer"),
        ({"pos_embed_TSC": np.zeros(3)}, "raw", "no weights of a MAGVIT-2 tokenizer"),
    ],
)
def test_files_of_something_else_are_refused(tensors: Tensors, weights: Weights, message: str) -> None:
    with pytest.raises(ConvertError, match=message):
        from_public("some.ckpt", tensors, weights)
