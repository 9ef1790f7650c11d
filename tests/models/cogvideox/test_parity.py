"""Transformer, autoencoder and schedule against ``diffusers``, where it is installed; weights out and in again."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.models.cogvideox import autoencoder
from rsjax.models.cogvideox import causal_vae as vae
from rsjax.models.cogvideox.config import CausalVAEConfig, CogVideoXConfig, GuidedDenoiseConfig, TextConfig
from rsjax.models.cogvideox.transformer import Architecture, Transformer, shapes
from rsjax.models.diffusion.samplers import denoise, sampler_coefficients
from rsjax.models.diffusion.schedule import alphas
from rsjax.tools.convert import cogvideox as convert
from rsjax.tools.convert.table import to_tensors

RNG = np.random.default_rng(0)
VAE = CausalVAEConfig(latent_channels=4, widths=(8, 16, 16, 16), res_blocks=1, norm_groups=4)
NET = CogVideoXConfig(
    autoencoder=VAE,
    text=TextConfig(file="text.safetensors", tokens=5, width=12),
    width=64,
    blocks=2,
    heads=2,
    time_width=24,
)
GRID = (3, 2, 3)  # frames, rows and columns of tokens
NETWORKS = {
    "2b": replace(NET, image="first_latent", positions="sincos"),
    "5b_i2v": replace(NET, learned_positions=GRID, stretch=(4, 9)),
}


def architecture(config: CogVideoXConfig) -> Architecture:
    return Architecture(config, GRID[0], *(config.patch_size * side for side in GRID[1:]))


def weights(of: Any) -> Any:
    """Draws weights that keep activations of order 1."""

    def draw(x: Any) -> np.ndarray:
        if x.ndim < 2:
            return RNG.normal(0.5, 0.2, x.shape).astype(np.float32)
        fan = int(np.prod(x.shape[:-1])) if x.ndim > 3 else x.shape[-2]
        return RNG.normal(scale=fan**-0.5, size=x.shape).astype(np.float32)

    return jax.tree.map(draw, of)


def loaded(module: Any, tensors: Any, torch: Any) -> Any:
    missing = module.load_state_dict({name: torch.from_numpy(np.array(x)) for name, x in tensors.items()}, strict=True)
    assert not missing.missing_keys
    return module.eval()


@pytest.mark.parametrize("name", NETWORKS)
def test_transformer_is_that_of_diffusers(name: str) -> None:
    torch, diffusers = pytest.importorskip("torch"), pytest.importorskip("diffusers", minversion="0.30")
    config, arch = NETWORKS[name], architecture(NETWORKS[name])
    params = weights(shapes(arch))
    settings = convert.transformer_settings(config)
    public = {k: v for k, v in settings.items() if not k.startswith("_")}
    public |= {"sample_height": arch.rows, "sample_width": arch.columns, "sample_frames": 4 * GRID[0] - 3}
    module = loaded(
        diffusers.CogVideoXTransformer3DModel(**public),
        to_tensors(params, convert.transformer_table(config)),
        torch,
    )
    channels = config.image == "channels"
    latents, image = (RNG.normal(size=(2, n, arch.rows, arch.columns, 4)).astype(np.float32) for n in (GRID[0], 1))
    text, t = RNG.normal(size=(2, 5, 12)).astype(np.float32), np.array([0, 977])
    given = np.concatenate([image, np.zeros_like(latents[:, 1:])], 1)
    seen = np.concatenate([latents, given], -1) if channels else latents
    args: dict[str, Any] = {}
    if config.positions == "rotary":
        embeddings = pytest.importorskip("diffusers.models.embeddings")
        # What the public sampler makes of 2×3 tokens on 4×9: the same height, in the middle of the width.
        crop = ((0, 2), (4, 8))
        args["image_rotary_emb"] = embeddings.get_3d_rotary_pos_embed(32, crop, GRID[1:], GRID[0])
    with torch.no_grad():
        inputs = [torch.from_numpy(x) for x in (seen.transpose(0, 1, 4, 2, 3).copy(), text, t)]
        expected = module(*inputs, **args, return_dict=False)[0].numpy().transpose(0, 1, 3, 4, 2)
    apply: Any = jax.jit(Transformer(arch).apply)
    made = apply({"params": params}, latents, t, text, image[:, 0] if channels else None)
    assert 0.3 < expected.std() < 10
    np.testing.assert_allclose(made, expected, atol=1e-5 * max(1, expected.std()))


def test_autoencoder_is_that_of_diffusers_piece_by_piece() -> None:
    torch, diffusers = pytest.importorskip("torch"), pytest.importorskip("diffusers", minversion="0.30")
    of = jax.eval_shape(lambda key: autoencoder.init(VAE, key), jax.random.key(0))
    params = weights(of)
    params["latents"] = {"mean": np.zeros(4, np.float32), "log_deviation": np.full(4, -np.log(0.7), np.float32)}
    networks = {name: params[name] for name in ("encoder", "decoder")}
    settings = {k: v for k, v in convert.autoencoder_settings(VAE, params).items() if not k.startswith("_")}
    tensors = to_tensors(networks, convert.autoencoder_table(networks))
    module = loaded(diffusers.AutoencoderKLCogVideoX(**settings), tensors, torch)
    frames = RNG.normal(size=(1, 17, 16, 24, 3)).astype(np.float32)
    for count, latent in ((17, 5), (9, 3), (1, 1)):
        with torch.no_grad():
            posterior = module.encode(torch.from_numpy(frames[:, :count].transpose(0, 4, 1, 2, 3).copy())).latent_dist
            expected = posterior.parameters.numpy().transpose(0, 2, 3, 4, 1)
            z = RNG.normal(size=(1, latent, 2, 3, 4)).astype(np.float32)
            shown = module.decode(torch.from_numpy(z.transpose(0, 4, 1, 2, 3).copy())).sample.numpy()
        made, back = (
            jax.jit(vae.encode, static_argnums=0)(VAE, params, frames[:, :count]),
            jax.jit(vae.decode, static_argnums=0)(VAE, params, z),
        )
        assert made.shape[1] == latent
        assert back.shape[1] == count
        for ours, theirs in ((made, expected), (back, shown.transpose(0, 2, 3, 4, 1))):
            assert 0.1 < theirs.std() < 10
            np.testing.assert_allclose(ours, theirs, atol=1e-5 * max(1, theirs.std()))


@pytest.mark.parametrize("shift", [1.0, 3.0])
def test_schedule_and_sampler_are_those_of_diffusers(shift: float) -> None:
    torch, diffusers = pytest.importorskip("torch"), pytest.importorskip("diffusers", minversion="0.30")
    scheduler = diffusers.CogVideoXDDIMScheduler(
        prediction_type="v_prediction",
        rescale_betas_zero_snr=True,
        snr_shift_scale=shift,
        timestep_spacing="trailing",
        clip_sample=False,
    )
    noise = replace(NET.noise, snr_shift=shift)
    np.testing.assert_allclose(alphas(noise), scheduler.alphas_cumprod.numpy(), atol=1e-12)
    scheduler.set_timesteps(50)
    start = RNG.normal(size=(2, 5)).astype(np.float32)
    x = torch.from_numpy(start)
    for t in scheduler.timesteps:
        x = scheduler.step(torch.tanh(x * (1 + t / 1000)), t, x).prev_sample
    plan = sampler_coefficients(noise, GuidedDenoiseConfig())
    np.testing.assert_array_equal(plan.t, scheduler.timesteps)
    made = denoise(plan, lambda x, t: jnp.tanh(x * (1 + t / 1000)), jnp.asarray(start))
    np.testing.assert_allclose(made, x.numpy(), atol=1e-5)
