"""SDXL's autoencoder against ``diffusers``, where it is installed; what its training and its codec promise."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import ConfigError
from rsjax.layers.cpu import convolution
from rsjax.models.base import create_autoencoder
from rsjax.models.irasim.autoencoder import KLCodec, decode, init, posterior
from rsjax.models.irasim.config import KLConfig
from rsjax.tools.bench import inputs
from rsjax.tools.convert.kl_autoencoder import from_public, infer_config, to_public
from rsjax.tools.describe import count
from rsjax.trainable import StepContext
from tests.models.irasim import toy

SMALL = KLConfig(channels=8, channel_multipliers=(1, 2, 2), res_blocks=1, norm_groups=4)
RNG = np.random.default_rng(0)


def test_posterior_and_images_are_those_of_diffusers() -> None:
    torch, diffusers = pytest.importorskip("torch"), pytest.importorskip("diffusers")
    torch.manual_seed(0)
    vae = diffusers.AutoencoderKL(
        block_out_channels=(8, 16, 16),
        down_block_types=["DownEncoderBlock2D"] * 3,
        up_block_types=["UpDecoderBlock2D"] * 3,
        layers_per_block=1,
        norm_num_groups=4,
        latent_channels=4,
    ).eval()
    with torch.no_grad():
        for x in vae.parameters():
            x.copy_(torch.randn(x.shape) * (0.3 if x.ndim == 1 else 1.2 * x[0].numel() ** -0.5))
    tensors = {name: x.numpy() for name, x in vae.state_dict().items()}
    config, params = from_public("file", tensors, {"norm_num_groups": 4})
    assert config == SMALL
    images = RNG.uniform(-1, 1, (2, 16, 24, 3)).astype(np.float32)
    with torch.no_grad():
        of_images = vae.encode(torch.from_numpy(images.transpose(0, 3, 1, 2))).latent_dist
        decoded = vae.decode(of_images.mean).sample.numpy().transpose(0, 2, 3, 1)
    mean, log_variance = posterior(config, params, jnp.asarray(images))
    for own, public in ((mean, of_images.mean), (log_variance, of_images.logvar)):
        assert public.std() > 0.1
        np.testing.assert_allclose(own, public.numpy().transpose(0, 2, 3, 1), atol=1e-5)
    assert decoded.std() > 0.1
    np.testing.assert_allclose(decode(config, params, mean), decoded, atol=1e-5)


def test_export_names_every_parameter_and_comes_back() -> None:
    params = toy.drawn(jax.eval_shape(lambda key: init(SMALL, key), jax.random.key(0)))
    params["latents"] = {"mean": np.zeros(4, np.float32), "log_deviation": np.full(4, 1.5, np.float32)}
    tensors, settings = to_public(SMALL, params)
    config, again = from_public("file", tensors, settings)
    assert config == SMALL
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), params, again)
    older = {name.replace("to_out.0", "proj_attn").replace("to_q", "query"): x for name, x in tensors.items()}
    older = {n: x[..., None, None] if "attentions" in n and x.ndim == 2 else x for n, x in older.items()}
    jax.tree.map(np.testing.assert_array_equal, again, from_public("file", older, settings)[1])


def test_parameters_are_as_many_as_published_and_inference_finds_sdxl() -> None:
    shapes = jax.eval_shape(lambda key: init(KLConfig(), key), jax.random.key(0))
    assert count(shapes) - count(shapes["latents"]) == 83_653_863
    empty = jax.tree.map(lambda x: np.broadcast_to(np.float32(0), x.shape), shapes)
    tensors, _ = to_public(KLConfig(), empty)
    assert len(tensors) == 248
    assert infer_config("file", tensors, {}) == KLConfig()


def test_codec_standardises_by_the_parameters() -> None:
    config = toy.config()
    params = toy.autoencoder_params(config)
    plain = params | {"latents": jax.tree.map(np.zeros_like, params["latents"])}
    video = Video(RNG.integers(0, 256, (2, 3, 64, 64, 3), np.uint8))
    codec, of_plain = (KLCodec(toy.AUTOENCODER, p, inputs.normalization(config)) for p in (params, plain))
    latents, own = codec.encode(video), of_plain.encode(video)
    mean, deviation = params["latents"]["mean"], np.exp(params["latents"]["log_deviation"])
    np.testing.assert_allclose(latents["mean"], (own["mean"] - mean) / deviation, atol=1e-5)
    np.testing.assert_allclose(latents["deviation"], own["deviation"] / deviation, atol=1e-5)
    decoded = [codec.decode(latents).rgb, of_plain.decode(own).rgb]
    assert np.abs(decoded[0].astype(int) - decoded[1]).max() <= 1
    assert decoded[0].shape == video.rgb.shape


def test_statistics_fit_best_at_those_of_the_latents_and_nothing_else_follows_them() -> None:
    autoencoder: Any = create_autoencoder(toy.config())
    params, key = jax.jit(autoencoder.init)(jax.random.key(0)), jax.random.key(0)
    images = jnp.asarray(RNG.integers(0, 256, (2, 64, 64, 3), np.uint8))
    batch, context = {"frames": images, "index": jnp.array([4, 7])}, StepContext(jnp.int32(0), None, None)

    @jax.jit
    def gradient(latents: Any) -> Any:
        every = params | {"latents": latents}
        return jax.grad(lambda p: autoencoder.loss_terms(p, batch, key, context)["standard"][0])(every)

    mean, log_variance = jax.jit(posterior, static_argnums=0)(toy.AUTOENCODER, params, images / 127.5 - 1)
    noise = jnp.stack([jax.random.normal(jax.random.fold_in(key, i), mean.shape[1:]) for i in (4, 7)])
    drawn = mean + jnp.exp(log_variance / 2) * noise
    right = {"mean": drawn.mean((0, 1, 2)), "log_deviation": jnp.log(drawn.std((0, 1, 2)))}
    for part, found in gradient(right).items():
        assert max(np.abs(x).max() for x in jax.tree.leaves(found)) < 1e-4, part
    above = gradient(jax.tree.map(lambda x: x + 0.1, right))["latents"]
    assert all((x > 1e-3).all() for x in above.values())


@pytest.mark.usefixtures("bf16_units")
@pytest.mark.parametrize("config", [SMALL, toy.AUTOENCODER], ids=lambda config: config.network)
def test_bf16_rounds_its_convolutions_and_keeps_its_parameters(
    monkeypatch: pytest.MonkeyPatch, config: KLConfig
) -> None:
    monkeypatch.setattr(convolution, "LEAST", 8)
    half = replace(config, compute_dtype="bfloat16")
    one, other = (jax.eval_shape(partial(init, each), jax.random.key(0)) for each in (config, half))
    assert one == other
    params = toy.drawn(one)
    images = jnp.asarray(RNG.uniform(-1, 1, (1, 32, 32, 3)), jnp.float32)
    side = 32 // config.downsampling
    latents = jnp.asarray(RNG.normal(size=(1, side, side, config.latent_channels)), jnp.float32)

    def both(config: KLConfig, params: Any) -> tuple[Any, Any]:
        return posterior(config, params, images)[0], decode(config, params, latents)

    run = jax.jit(both, static_argnums=0)
    for exact, rough in zip(run(config, params), run(half, params), strict=True):
        assert 0 < np.abs(rough - exact).max() < 0.05 * np.abs(exact).max()


def test_terms_are_those_with_a_weight() -> None:
    autoencoder: Any = create_autoencoder(toy.config())
    terms = jax.eval_shape(
        autoencoder.loss_terms,
        autoencoder.shapes(),
        {"frames": jax.ShapeDtypeStruct((2, 64, 64, 3), np.uint8), "index": jax.ShapeDtypeStruct((2,), np.int32)},
        jax.random.key(0),
        StepContext(jnp.int32(0), None, None),
    )
    assert terms.keys() == autoencoder.loss_weights.keys() == {"l1", "l2", "kl", "standard"}


def test_impossible_networks_are_refused() -> None:
    with pytest.raises(ConfigError, match="belong to the network magvit2"):
        replace(KLConfig(), patch_size=2)
    with pytest.raises(ConfigError, match="norm_groups 5 does not divide"):
        KLConfig(norm_groups=5)
