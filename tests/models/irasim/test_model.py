"""IRASim through the stages of a run, and what its loss and its rollouts must and must not depend on."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rsjax
from rsjax.bench import inputs
from rsjax.clip import Video
from rsjax.config import Config, DenoiseConfig, KLConfig
from rsjax.convert.directory import save
from rsjax.describe import describe
from rsjax.errors import UserError
from rsjax.models.base import Assets, create_autoencoder, create_model
from rsjax.models.irasim.dit import Architecture, forward_flops
from rsjax.models.irasim.model import latent_arrays
from rsjax.models.irasim.rollout import rollout
from rsjax.pipeline.own_data import on_store
from rsjax.pipeline.run import Run
from rsjax.pipeline.stages import run_all
from rsjax.pipeline.videos import resampled
from rsjax.trainable import StepContext
from tests.models.irasim import toy
from tests.pipeline.toy import store

CONFIG = toy.config()
MODEL: Any = create_model(CONFIG)
RNG = np.random.default_rng(0)


def test_a_run_trains_both_networks_generates_and_is_evaluated(tmp_path: Path) -> None:
    clips = store(tmp_path / "clips")
    run = Run(on_store(CONFIG, clips.path), tmp_path / "run", tmp_path)
    run.prepare(overwrite=False)
    run_all(run)
    assert run.stages == ("collect", "tokenizer", "tokens", "world_model", "evaluation", "report")
    metrics = json.loads((run.directory / "metrics.json").read_text())
    assert {"psnr", "psnr_tokenizer", "delta_psnr"} <= metrics.keys()
    assert metrics["psnr"] > 0
    rows = [json.loads(line) for line in (run.directory / "world_model" / "log.jsonl").read_text().splitlines()]
    assert 0.5 < next(row["error"] for row in rows if "error" in row) < 1.5, "fresh, it predicts zeros, not the noise"
    prepared, trained = run.open_prepared(), rsjax.load(run.directory)
    assert prepared.counts() == clips.counts()
    record, clip = prepared.source("test")[0], clips.source("test")[0]
    assert record["mean"].dtype == np.float16
    video = trained.generate(clip["rgb"][:1], clip["actions"])
    assert video.rgb.shape == clip["rgb"].shape
    assert video.depth is None
    with pytest.raises(UserError, match="has no setting temperature; it has sampler, steps"):
        resampled(trained, {"temperature": 1.0})
    assert resampled(trained, {"steps": 5}).model.config.sample.steps == 5

    # The run's weights start another run; those of another network are refused, with the fields that differ.
    again = replace(CONFIG, train=replace(CONFIG.train, start_from=str(run.directory)))
    start = create_model(again)
    assert start.pretrained_shapes(run.directory).keys() == trained.params.keys()
    with pytest.raises(UserError, match="holds another network .width is 16 there, 32 here"):
        create_model(toy.config(width=32)).pretrained_shapes(run.directory)
    other = replace(toy.AUTOENCODER, channels=16)
    with pytest.raises(UserError, match="holds another autoencoder .channels is 8 there, 16 here"):
        create_autoencoder(toy.config(autoencoder=other)).pretrained_shapes(run.directory)
    assert create_autoencoder(CONFIG).pretrained_shapes(run.directory).keys() == {"encoder", "decoder", "latents"}


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
    draws = np.stack([latent_arrays(normalization, record, np.random.default_rng(i))["latents"] for i in range(200)])
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


def test_videos_start_with_the_prompt_as_the_autoencoder_sees_it() -> None:
    assets = Assets(inputs.normalization(CONFIG), toy.autoencoder_params(CONFIG))
    prompt, actions = inputs.video(CONFIG, 1, 1), np.zeros((1, 6, CONFIG.clips.action_dim), np.float32)
    made = MODEL.generate(toy.params(CONFIG), assets, prompt, actions)
    np.testing.assert_array_equal(made.rgb[:, :1], MODEL.reconstruct(assets, Video(prompt.rgb)).rgb)


def test_actions_of_another_length_begin_fresh(tmp_path: Path) -> None:
    params = toy.params(CONFIG)
    arch = MODEL.architecture
    save(tmp_path / "there", arch, params)
    wider = create_model(on_width(CONFIG, arch.action_inputs + 3))
    assert wider.pretrained_shapes(tmp_path / "there")["action_fc1"]["kernel"].shape[0] == arch.action_inputs
    fresh = jax.tree.map(lambda x: np.zeros(x.shape), jax.eval_shape(wider.init, jax.random.key(0)))
    begun = wider.start(fresh, params, tmp_path)
    assert begun["action_fc1"]["kernel"].shape[0] == arch.action_inputs + 3
    assert not begun["action_fc1"]["bias"].any()
    np.testing.assert_array_equal(begun["final"]["kernel"], params["final"]["kernel"])


def on_width(config: Config, width: int) -> Config:
    """The configuration on clips with actions of another length."""
    clips = config.clips
    shape = {name: getattr(clips, name) for name in ("frames", "image_size", "tracks", "test_clips")}
    return replace(config, data=replace(config.data, store="x", key="x", action_dim=width, **shape))


def test_directories_of_something_else_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no tokenizer/weights .* make it with python -m rsjax.convert sdxl"):
        create_autoencoder(CONFIG).pretrained_shapes(tmp_path)
    (tmp_path / "tokenizer" / "weights").mkdir(parents=True)
    (tmp_path / "config.json").write_text('{"tokenizer": {}}')
    with pytest.raises(UserError, match="describes no network of IRASim but tokenizer"):
        create_autoencoder(CONFIG).pretrained_shapes(tmp_path)


def test_operations_are_counted_and_described() -> None:
    description = describe(toy.config(sample=DenoiseConfig("ddim", steps=2)))
    figures = description.figures
    assert figures["flops_per_frame"] == forward_flops(MODEL.architecture) // CONFIG.clips.frames
    params = jax.eval_shape(create_model(CONFIG).init, jax.random.key(0))
    assert figures["params_world_model"] == sum(x.size for x in jax.tree.leaves(params))
    tiny = Architecture(width=128, blocks=8, heads=4, patch_size=1, rows=8, columns=8, channels=16)
    assert forward_flops(tiny) == pytest.approx(3.5e9, rel=0.05)
    assert KLConfig().downsampling == 8
