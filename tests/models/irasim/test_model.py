"""What IRASim's loss and its rollouts must and must not depend on."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import Config, DataConfig
from rsjax.config.config_fields import with_values
from rsjax.models.base import Assets, create_model
from rsjax.models.irasim.config import KLConfig
from rsjax.models.irasim.dit import Architecture, forward_flops
from rsjax.models.irasim.model import latent_arrays
from rsjax.models.irasim.rollout import rollout
from rsjax.tools.bench import inputs
from rsjax.tools.convert.directory import save
from rsjax.trainable import StepContext
from tests.models.irasim import toy

CONFIG = toy.config()
MODEL: Any = create_model(CONFIG)
RNG = np.random.default_rng(0)


def batch(clips: int = 3) -> Any:
    return inputs.batch(MODEL, CONFIG, clips)


@jax.jit
def loss(params: Any, batch: Any) -> Any:
    value, weight = MODEL.loss_terms(params, batch, jax.random.key(0), StepContext(jnp.int32(0), None, None))["error"]
    return value / weight


def test_padding_and_order_do_not_change_the_loss() -> None:
    params, clips = toy.params(CONFIG), batch()
    whole = loss(params, clips)
    assert np.isfinite(whole)
    turned = {name: x[::-1] for name, x in clips.items()}
    np.testing.assert_allclose(loss(params, turned), whole, rtol=1e-5)
    alone = {name: x[jnp.array([1, 1, 1])] for name, x in clips.items()}
    padded = {name: x.at[jnp.array([0, 2])].set(x[1]) for name, x in clips.items()} | {
        "weight": jnp.array([0.0, 1.0, 0.0])
    }
    np.testing.assert_allclose(loss(params, padded), loss(params, alone), rtol=1e-5)


def test_the_given_frame_is_clean_and_no_target() -> None:
    """The first frame's noise has no part in the loss: what is drawn for it changes neither input nor target."""
    params, clips = toy.params(CONFIG), batch(1)
    seen: list[Any] = []

    def spy(*args: Any, **kwargs: Any) -> Any:
        seen.append(args)
        return jnp.zeros_like(args[1])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rsjax.models.irasim.model.DiT", lambda arch: type("Spy", (), {"apply": staticmethod(spy)}))
        key, context = jax.random.key(0), StepContext(jnp.int32(0), None, None)
        value, _ = MODEL.loss_terms(params, clips, key, context)["error"]
    (_, noisy, t, actions, _) = seen[0]
    np.testing.assert_array_equal(noisy[:, 0], clips["latents"][:, 0])
    assert np.abs(noisy[:, 1:] - clips["latents"][:, 1:]).min(axis=(0, 2, 3, 4)).max() > 0
    assert 0 <= t[0] < 1000
    np.testing.assert_array_equal(actions, clips["actions"])
    drawn_frames = CONFIG.clips.frames - 1
    assert value == pytest.approx(1.0, abs=6 / np.sqrt(clips["latents"][0, :1].size * drawn_frames))


def test_loaders_draw_latents_from_the_posterior() -> None:
    record, normalization = MODEL.example(RNG), inputs.normalization(CONFIG)
    rngs = map(np.random.default_rng, range(200))
    draws = np.stack([latent_arrays(normalization, False, record, rng)["latents"] for rng in rngs])
    np.testing.assert_allclose(draws.mean(0), record["mean"].astype(np.float32), atol=0.05)
    np.testing.assert_allclose(draws.std(0), record["deviation"].astype(np.float32), atol=0.03)


Roll = Callable[..., np.ndarray]


@pytest.fixture(scope="module")
def roll() -> Roll:
    """Rollouts of random weights from a one-frame prompt."""
    arch = MODEL.architecture
    shape = (arch.rows, arch.columns, arch.channels)
    prompt = RNG.normal(size=(2, 1, *shape)).astype(np.float32)
    actions = RNG.normal(size=(2, 3 * arch.frames, arch.action_inputs)).astype(np.float32)

    def made(rows: Any = slice(None), frames: int = arch.frames, index: Any = (7, 8), change: int | None = None) -> Any:
        acts = actions[rows, :frames].copy()
        if change is not None:
            acts[:, change] += 1
        numbers = np.array(index)[rows]
        return rollout(arch, MODEL.config, 1, toy.params(CONFIG), prompt[rows], acts, numbers)

    return made


def test_rollouts_keep_their_prompt_and_depend_on_number_and_actions(roll: Roll) -> None:
    frames = MODEL.architecture.frames
    whole = roll()
    assert whole.shape[1] == frames
    assert np.isfinite(whole).all()
    np.testing.assert_allclose(roll(rows=slice(1, 2)), whole[1:], rtol=1e-4, atol=1e-2)
    other = roll(index=(7, 9))
    np.testing.assert_allclose(other[0], whole[0], rtol=1e-4, atol=1e-2)
    assert np.abs(other[1, 1:] - whole[1, 1:]).max() > 0.1
    np.testing.assert_array_equal(other[:, 0], whole[:, 0])
    assert np.abs(roll(change=2) - whole).max() > 1e-3
    np.testing.assert_array_equal(roll(change=0), whole)


def test_long_rollouts_continue_chunk_by_chunk(roll: Roll) -> None:
    frames = MODEL.architecture.frames
    short, long = roll(), roll(frames=2 * frames)
    assert long.shape[1] == 2 * frames
    np.testing.assert_allclose(long[:, :frames], short, rtol=1e-4, atol=1e-2)
    later = roll(frames=2 * frames, change=frames + 1)
    np.testing.assert_array_equal(later[:, :frames], long[:, :frames])
    assert np.abs(later[:, frames:] - long[:, frames:]).max() > 1e-3


def test_with_sums_a_chunk_reads_them_from_its_own_first_frame_on() -> None:
    """As a training clip does: a rollout of two chunks is one of the second chunk alone, from the first one's end."""
    model: Any = create_model(toy.config(integrate_actions=True))
    arch, width = model.architecture, CONFIG.clips.action_dim
    assert arch.action_inputs == 2 * width
    record = model.example(RNG)
    row = latent_arrays(inputs.normalization(CONFIG), True, record, RNG)["actions"]
    np.testing.assert_allclose(row[1:, width:], np.cumsum(record["actions"][1:], 0) / 4, rtol=1e-5, atol=1e-6)
    seen: list[Any] = []

    def chunk(arch: Any, config: Any, params: Any, key: Any, known: Any, actions: Any, index: Any) -> Any:
        seen.append(np.asarray(actions))
        return np.zeros((1, arch.frames, *known.shape[2:]), np.float32)

    actions = RNG.normal(size=(1, 2 * arch.frames - 3, width)).astype(np.float32)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rsjax.models.irasim.rollout._chunk", chunk)
        prompt = np.zeros((1, 1, arch.rows, arch.columns, arch.channels), np.float32)
        rollout(arch, model.config, 1, {}, prompt, actions, np.array([0]))
    for number, part in enumerate(seen):
        first = number * (arch.frames - 1)
        own = actions[:, first + 1 : first + arch.frames]
        own = np.concatenate([own, np.repeat(own[:, :1], arch.frames - 1 - own.shape[1], axis=1)], axis=1)
        np.testing.assert_allclose(part[:, 1:], np.concatenate([own, np.cumsum(own, 1) / 4], -1), rtol=1e-5, atol=1e-6)
    assert len(seen) == 2


def test_videos_start_with_the_prompt_as_the_autoencoder_sees_it() -> None:
    assets = Assets(inputs.normalization(CONFIG), toy.autoencoder_params(CONFIG))
    prompt, actions = inputs.video(CONFIG, 1, 1), np.zeros((1, 6, CONFIG.clips.action_dim), np.float32)
    made = MODEL.generate(toy.params(CONFIG), assets, prompt, actions)
    own = MODEL.reconstruct(assets, Video(prompt.rgb)).rgb.astype(int)
    assert np.abs(made.rgb[:, :1] - own).max() <= 1  # at a half, rounding follows float32's last bit


def test_actions_of_another_length_begin_fresh(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    params = toy.params(CONFIG)
    arch = MODEL.architecture
    save(tmp_path / "there", arch, params)
    wider = create_model(on_width(CONFIG, arch.action_inputs + 3))
    assert wider.pretrained_shapes(tmp_path / "there")["action_fc1"]["kernel"].shape[0] == arch.action_inputs
    lengths = f"its actions have {arch.action_inputs} numbers, these {arch.action_inputs + 3}"
    assert f"{lengths}; the first layer of the action encoder begins fresh" in capsys.readouterr().out
    unrolled = create_model(with_values(CONFIG, {"model.unroll": 2}))
    assert unrolled.pretrained_shapes(tmp_path / "there") and not capsys.readouterr().out
    fresh = jax.tree.map(lambda x: np.zeros(x.shape), jax.eval_shape(wider.init, jax.random.key(0)))
    begun = wider.start(fresh, params, tmp_path)
    assert begun["action_fc1"]["kernel"].shape[0] == arch.action_inputs + 3
    assert not begun["action_fc1"]["bias"].any()
    np.testing.assert_array_equal(begun["final"]["kernel"], params["final"]["kernel"])


def on_width(config: Config, width: int) -> Config:
    """The configuration on clips with actions of another length."""
    clips = config.clips
    shape = {name: getattr(clips, name) for name in ("frames", "image_size", "tracks", "test_clips")}
    return replace(config, data=DataConfig(store="x", key="x", action_dim=width, **shape))


def test_operations_are_counted() -> None:
    assert MODEL.flops(CONFIG.clips.frames)["forward"] == forward_flops(MODEL.architecture)
    tiny = Architecture(width=128, blocks=8, heads=4, patch_size=1, rows=8, columns=8, channels=16)
    assert forward_flops(tiny) == pytest.approx(3.5e9, rel=0.05)
    assert KLConfig().downsampling == 8
