"""The conditional VQ tokenizer: its size, what depends on what, and the same results as plain PyTorch's."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import ConfigError, TokenizerTrainConfig
from rsjax.layers.cpu import convolution
from rsjax.models.ivideogpt.autoencoder import ConditionalCodec, ConditionalVQTraining
from rsjax.models.ivideogpt.conditional_vq import Codebook, ConditionalVQ
from rsjax.models.ivideogpt.config import ConditionalVQConfig
from rsjax.tools.convert.ivideogpt import infer_tokenizer, tokenizer_from_public, tokenizer_shapes, tokenizer_table
from rsjax.tools.convert.table import public_shapes, to_tensors
from rsjax.tools.describe import count
from rsjax.trainable import StepContext
from tests.models.ivideogpt.toy import SIZE, VQ, frames, vq_params

LARGE = ConditionalVQConfig(context_frames=2, widths=(128, 256, 256, 512, 768), attention_size=32)


@pytest.mark.parametrize(
    ("config", "size", "parameters"),
    [
        (ConditionalVQConfig(), 64, 113_831_494),
        (LARGE, 256, 310_472_774),
    ],
    ids=["64-1", "256-2"],
)
def test_public_sizes_have_their_exact_counts_and_are_known_by_their_shapes(
    config: ConditionalVQConfig, size: int, parameters: int
) -> None:
    shapes = tokenizer_shapes(config, size)
    assert count(shapes) == parameters
    public = public_shapes(tokenizer_table(shapes), shapes)
    assert infer_tokenizer("here", {name: np.broadcast_to(0.0, x) for name, x in public.items()}) == (config, size)


def test_a_later_frame_depends_on_the_context_and_its_own_tokens_alone() -> None:
    codec = ConditionalCodec(VQ, vq_params())
    tokens = codec.encode(Video(frames(1, 4)))
    assert tokens["context"].shape == (1, 1, 8, 8) and tokens["future"].shape == (1, 3, 4)
    seen = codec.decode(tokens).rgb
    assert seen.shape == (1, 4, SIZE, SIZE, 3)
    changed = {name: x.copy() for name, x in tokens.items()}
    changed["future"][:, 1] += 1
    differs = (codec.decode(changed).rgb != seen).any((0, 2, 3, 4))
    assert differs.tolist() == [False, False, True, False]
    changed = {"context": (tokens["context"] + 1) % VQ.codes, "future": tokens["future"]}
    assert (codec.decode(changed).rgb != seen).any((0, 2, 3, 4)).all()
    other = frames(1, 4)
    other[:, 2] = 255 - other[:, 2]
    again = codec.encode(Video(other))
    np.testing.assert_array_equal(again["context"], tokens["context"])
    assert (again["future"] != tokens["future"]).any((0, 2)).tolist() == [False, True, False]


def test_clips_are_encoded_alike_in_any_number_and_a_prompt_may_be_short() -> None:
    config = replace(VQ, context_frames=2)
    codec, clips = ConditionalCodec(config, vq_params(config)), frames(3, 3)
    together, alone = codec.encode(Video(clips)), codec.encode(Video(clips[2:]))
    for name in together:
        np.testing.assert_array_equal(together[name][2:], alone[name])
    single = codec.encode(Video(clips[:1, :1]))
    assert single["future"].shape == (1, 0, 4), "one frame is repeated to two of context, and none is left"
    np.testing.assert_array_equal(single["context"], codec.encode(Video(clips[:1, [0, 0]]))["context"])
    assert codec.decode(single).rgb.shape == (1, 2, SIZE, SIZE, 3)


@pytest.mark.usefixtures("bf16_units")
def test_bf16_rounds_its_convolutions_and_keeps_its_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(convolution, "LEAST", 8)
    params, images, rng = vq_params(), frames(1, 3) / np.float32(255), np.random.default_rng(0)
    codes = [rng.normal(size=(1, *shape, VQ.latent)).astype(np.float32) for shape in ((1, 8, 8), (2, 4))]

    def run(config: ConditionalVQConfig) -> Any:
        network = ConditionalVQ(config)
        methods = {"_latents": (images,), "_images": codes}
        return jax.jit(lambda p: [network.apply({"params": p}, *x, method=name) for name, x in methods.items()])(params)

    exact, rough = (jax.tree.leaves(run(replace(VQ, compute_dtype=dtype))) for dtype in ("float32", "bfloat16"))
    for one, other in zip(exact, rough, strict=True):
        assert 0 < np.abs(other - one).max() < 0.05 * np.abs(one).max()


def test_the_codebook_takes_the_nearest_vector_and_passes_the_gradient_through() -> None:
    vectors = {"params": {"embedding": jnp.array([[0.0, 0], [1, 1], [3, 0]] + [[9.0, 9]] * 29)}}
    book, z = Codebook(replace(VQ, latent=2)), jnp.array([[0.9, 0.7], [2.5, 0.4]])
    np.testing.assert_array_equal(book.apply(vectors, z, method="nearest"), [1, 2])
    outs: Any = book.apply(vectors, z)
    out, codebook, commitment = outs
    np.testing.assert_allclose(out, [[1, 1], [3, 0]])
    assert float(codebook) == pytest.approx(float(commitment)) == pytest.approx((0.01 + 0.09 + 0.25 + 0.16) / 4)
    gradient = jax.grad(lambda z: jnp.sum(book.apply(vectors, z)[0] * jnp.array([2.0, 3])))(z)
    np.testing.assert_array_equal(gradient, [[2, 3], [2, 3]])


def test_losses_are_the_sums_over_both_kinds_of_frames_of_a_plain_loop() -> None:
    config = replace(VQ, context_frames=2, codebook_weight=0.5)
    params, clips = vq_params(config), frames(2, 5)
    train = TokenizerTrainConfig(frames_per_clip=5, l1_weight=2.0, l2_weight=3.0, commitment_weight=0.25)
    training = ConditionalVQTraining(config, train, SIZE)
    batch = {"frames": clips, "index": np.arange(2)}
    context = StepContext(jnp.int32(0), None, None)
    terms = jax.jit(lambda params: training.loss_terms(params, batch, jax.random.key(0), context))(params)

    network, images = ConditionalVQ(config), clips / np.float32(255)
    wanted = {"l1": 0.0, "l2": 0.0, "codebook": 0.0, "commitment": 0.0}
    run = jax.jit(network.apply, static_argnames="method")
    latents: Any = run({"params": params}, images, method="_latents")
    near = []
    for z, book in zip(latents, ("quantize", "dynamics_quantize"), strict=True):
        vectors = np.asarray(params[book]["embedding"], np.float64)
        rows = np.asarray(z, np.float64).reshape(-1, config.latent)
        chosen = np.stack([vectors[np.argmin([np.sum((row - v) ** 2) for v in vectors])] for row in rows])
        for name in ("codebook", "commitment"):
            wanted[name] += float(np.sum((chosen - rows) ** 2) / rows.size)
        near.append(chosen.reshape(z.shape).astype(np.float32))
    made: Any = run({"params": params}, *near, method="_images")
    for true, other in zip((images[:, :2], images[:, 2:]), made, strict=True):
        differences = np.asarray(true, np.float64) - other
        wanted["l1"] += float(np.abs(differences).sum() / differences.size)
        wanted["l2"] += float((differences**2).sum() / differences.size)

    assert training.loss_weights == {"l1": 2.0, "l2": 3.0, "codebook": 0.5, "commitment": 0.25}
    assert {name: float(count) for name, (_, count) in terms.items()} == dict.fromkeys(wanted, 2.0)
    got = {name: float(total) / 2 for name, (total, _) in terms.items()}
    assert got == pytest.approx(wanted, rel=1e-4)


def test_dropout_follows_the_clip_and_not_its_place_in_the_batch() -> None:
    """What accumulation and every sharding need: the terms of parts add up to those of the whole."""
    config = replace(VQ, patch_size=2, widths=(8,), dropout=0.1)
    params = vq_params(config)
    training = ConditionalVQTraining(config, TokenizerTrainConfig(frames_per_clip=3), SIZE)
    batch = {"frames": frames(2, 3), "index": np.arange(2)}
    context = StepContext(jnp.int32(0), None, None)
    terms = jax.jit(lambda params, batch: training.loss_terms(params, batch, jax.random.key(0), context))
    parts = [terms(params, {name: x[i : i + 1] for name, x in batch.items()}) for i in range(2)]
    for name, term in terms(params, batch).items():
        np.testing.assert_allclose(np.add(parts[0][name], parts[1][name]), term, rtol=2e-4, err_msg=name)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"norm_groups": 3}, r"model.autoencoder.widths are \(8, 16\); .* norm_groups 3"),
        ({"latent": 0}, "model.autoencoder.latent is 0; it must be at least 1"),
    ],
)
def test_impossible_settings_are_refused(changes: dict[str, Any], line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        replace(VQ, **changes)


def test_images_that_are_too_large_for_attention_are_refused() -> None:
    with pytest.raises(ConfigError, match="attention_size is 16; it must be at least the grid of 32 cells"):
        VQ.grid(64)


@pytest.mark.parametrize("changes", [{}, {"context_frames": 2, "patch_size": 2}], ids=["plain", "patches-2-context"])
def test_tokens_and_images_are_those_of_plain_pytorch(changes: dict[str, Any]) -> None:
    torch = pytest.importorskip("torch")
    from benchmarks.pytorch.conditional_vq import ConditionalVQTorch, public_tensors

    config = replace(VQ, **changes)
    size = SIZE * config.patch_size
    reference = ConditionalVQTorch(config, size).eval()
    params = vq_params(config, size)
    tensors = to_tensors(params, tokenizer_table(params))
    assert tensors.keys() == public_tensors(reference).keys()
    reference.load_state_dict({name: torch.tensor(x) for name, x in tensors.items()})
    _, _, again = tokenizer_from_public("here", public_tensors(reference), (config, size))
    jax.tree.map(np.testing.assert_array_equal, again, params)
    clips = frames(2, config.context_frames + 2, size)
    with torch.no_grad():
        images = torch.tensor(clips).float().permute(0, 1, 4, 2, 3) / 255
        latents = [x.numpy() for x in reference.latents(images)]
        tokens = [x.numpy() for x in reference.tokenize(images)]
        decoded = reference.detokenize(*map(torch.tensor, tokens)).permute(0, 1, 3, 4, 2).numpy()
    network, variables = ConditionalVQ(config), {"params": params}
    own = network.apply(variables, jnp.float32(clips) / 255, method="_latents")
    for mine, theirs in zip(own, latents, strict=True):
        assert 0.1 < np.std(theirs) < 10
        np.testing.assert_allclose(mine.reshape(theirs.shape), theirs, atol=1e-5)
    made = network.apply(variables, clips, method="encode")
    for mine, theirs in zip(made, tokens, strict=True):
        np.testing.assert_array_equal(mine.reshape(theirs.shape), theirs)
    pixels: Any = network.apply(variables, *made, method="decode")
    np.testing.assert_allclose(pixels / 255, np.clip(decoded, 0, 1), atol=1e-5)
