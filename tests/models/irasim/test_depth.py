"""IRASim with depth as further channels of its latents: what is as without them, and what depth may change.

tests/models/test_families.py takes it through a whole run.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import Config, presets
from rsjax.config.config_fields import with_values
from rsjax.data.depth_color import color_to_depth, depth_to_color
from rsjax.data.normalization import Normalization
from rsjax.data.store import Store, encode_clip, open_store, write_store
from rsjax.errors import UserError
from rsjax.evaluation.metrics.psnr import psnr
from rsjax.models.base import Assets, create_autoencoder, create_model
from rsjax.models.irasim.autoencoder import KLCodec
from rsjax.models.irasim.config import KLConfig
from rsjax.models.irasim.dit import DiT
from rsjax.tools.bench import inputs
from rsjax.tools.convert.directory import save
from rsjax.tools.convert.files import ConvertError
from rsjax.tools.convert.irasim import export
from rsjax.tools.describe import count
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.validation import TokenizerValidation
from rsjax.trainable import StepContext
from tests.models.irasim import toy
from tests.tools.pipeline import toy as clips

RGB = toy.config()
DEPTH = with_values(RGB, {"model.autoencoder.depth": "inverse", "tokenizer_train.depth_share": 0.5})
RNG = np.random.default_rng(0)


def model(config: Config) -> Any:
    return create_model(config)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return clips.store(tmp_path_factory.mktemp("depth") / "clips")


def video(store: Store) -> Video:
    """Two test clips, of which only the first has depth."""
    records = [store.source("test")[number] for number in range(2)]
    depth = np.stack([record["depth"] for record in records])
    depth[1] = np.nan
    return Video(np.stack([record["rgb"] for record in records]), depth)


def codec(config: KLConfig, store: Store) -> KLCodec:
    return KLCodec(config, toy.autoencoder_params(RGB), Normalization.create(store))


def test_the_latents_of_rgb_are_as_without_depth_and_a_clip_without_depth_has_zeros(store: Store) -> None:
    frames = video(store)
    plain = codec(toy.AUTOENCODER, store).encode(frames)
    z = toy.AUTOENCODER.latent_channels
    both = codec(DEPTH.autoencoder, store).encode(frames)
    for name, x in both.items():
        np.testing.assert_array_equal(x[..., :z], plain[name])
        assert np.abs(x[0, ..., z:]).min() > 0
        assert not x[1, ..., z:].any()
    made = codec(DEPTH.autoencoder, store).decode(both, frames.has_depth)
    np.testing.assert_array_equal(made.rgb, codec(toy.AUTOENCODER, store).decode(plain).rgb)
    near, far = clips.DEPTH_RANGE
    assert made.depth is not None
    assert near <= made.depth[0].min() <= made.depth[0].max() <= far
    assert np.isnan(made.depth[1]).all()


def test_an_unknown_pixel_is_one_without_depth(store: Store) -> None:
    frames = video(store)
    assert frames.depth is not None
    holes = frames.depth.copy()
    holes[0, :, 3, 4] = np.nan
    zeros = np.nan_to_num(holes[:1], nan=0.0)
    ours = codec(DEPTH.autoencoder, store)
    found = ours.encode(Video(frames.rgb, holes))
    expected = ours.encode(Video(frames.rgb[:1], zeros))
    np.testing.assert_allclose(found["mean"][:1], expected["mean"], atol=1e-5)


def test_latents_say_whether_depth_is_known_in_a_clips_first_frame(tmp_path: Path, store: Store) -> None:
    known = clips.clip(0)
    assert known.depth is not None
    depth = known.depth.copy()
    depth[0] = np.nan
    records = [encode_clip(clip) for clip in (known, replace(known, depth=depth))]
    write_store(tmp_path / "clips", "clips", {"train": records, "test": records[:1]}, {"key": "holes"})
    assets = Assets(Normalization.create(store), toy.autoencoder_params(RGB))
    latents = model(DEPTH).prepare(open_store(tmp_path / "clips"), assets, tmp_path, 0.0).source("train")
    assert [bool(latents[number]["has_depth"]) for number in range(2)] == [True, False]


def test_depth_is_refused_where_no_training_clip_has_it(tmp_path: Path, store: Store) -> None:
    without = codec(DEPTH.autoencoder, clips.store(tmp_path / "clips", depth=False))
    with pytest.raises(UserError) as raised:
        without.encode(video(store))
    assert "depth_range is null" in str(raised.value)
    assert without.encode(Video(video(store).rgb))["mean"].shape[-1] == 2 * toy.AUTOENCODER.latent_channels


def test_weights_without_depth_begin_with_their_own_noise_of_rgb(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever the channels of depth hold, also with the variances of ``learn_sigma``."""
    sigma = {"model.learn_sigma": True}
    one, other = (model(with_values(config, sigma)) for config in (RGB, DEPTH))
    params = toy.params(with_values(RGB, sigma))
    save(tmp_path, one.architecture, params)
    shapes = other.pretrained_shapes(tmp_path)
    assert jax.tree.map(jnp.shape, shapes) == jax.tree.map(jnp.shape, params)
    assert "knows no depth; the network's weights for its channels begin at zero" in capsys.readouterr().out
    fresh = toy.params(with_values(DEPTH, sigma))
    begun = other.start(fresh, params, tmp_path)
    z = one.architecture.channels
    latents = RNG.normal(size=(2, *_shape(other))).astype(np.float32)
    actions = RNG.normal(size=(2, *_actions(other))).astype(np.float32)
    expected = noise(one, params, latents[..., :z], actions)
    found = noise(other, begun, latents, actions)
    np.testing.assert_allclose(found[..., :z], expected, atol=1e-5)
    assert np.abs(expected).min() > 0
    assert not found[..., z:].any()


def _shape(model: Any) -> tuple[int, ...]:
    arch = model.architecture
    return arch.frames, arch.rows, arch.columns, arch.inputs


def _actions(model: Any) -> tuple[int, int]:
    return model.architecture.frames, model.architecture.action_inputs


def noise(model: Any, params: Any, latents: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """The noise of latents at two steps."""
    made = jax.jit(DiT(model.architecture).apply)({"params": params}, latents, np.array([3, 700]), actions)
    return np.asarray(made)


def test_a_clip_without_depth_counts_in_the_term_of_rgb_alone() -> None:
    ours = model(DEPTH)
    params = toy.params(DEPTH)
    batch = inputs.batch(ours, DEPTH, 3)

    @jax.jit
    def terms(has_depth: Any, latents: Any) -> Any:
        part = batch | {"has_depth": has_depth, "latents": latents}
        return ours.loss_terms(params, part, jax.random.key(0), StepContext(jnp.int32(0), None, None))

    whole = terms(np.ones(3, np.float32), batch["latents"])
    assert whole.keys() == ours.loss_weights.keys() == {"error", "depth"}
    fewer = terms(np.array([1, 0, 1], np.float32), batch["latents"])
    assert fewer["error"] == whole["error"]
    assert (whole["depth"][1], fewer["depth"][1]) == (3, 2)
    assert fewer["depth"][0] < whole["depth"][0]
    none = terms(np.zeros(3, np.float32), batch["latents"])
    assert none["depth"] == (0, 0)


def test_depth_is_scored_in_the_validation_of_the_autoencoder_too(tmp_path: Path) -> None:
    run = Run(DEPTH, tmp_path / "run", tmp_path / "data")
    store = clips.store(run.clips)
    depth = np.stack([store.source("test")[number]["depth"] for number in range(clips.TEST)])
    ours = codec(DEPTH.autoencoder, store)
    pictures = ours.depth_pictures(depth)
    assert pictures is not None
    colors, decoded = pictures
    np.testing.assert_array_equal(colors, depth_to_color(depth, *clips.DEPTH_RANGE, "inverse").astype(np.uint8))
    both = Video(np.zeros_like(colors), depth)
    made = ours.decode(ours.encode(both), both.has_depth)
    np.testing.assert_array_equal(color_to_depth(decoded, *clips.DEPTH_RANGE, "inverse"), made.depth)
    found = TokenizerValidation(run)(3, ours.params)
    of_depth = float(psnr(colors, decoded).mean())
    assert found.scalars["validation/psnr_depth"] == pytest.approx(of_depth)
    assert found.metric == pytest.approx(-(found.scalars["validation/psnr"] + of_depth) / 2)
    assert codec(toy.AUTOENCODER, store).depth_pictures(depth) is None


def test_public_files_know_no_depth(tmp_path: Path) -> None:
    ours = model(DEPTH)
    save(tmp_path / "there", ours.architecture, toy.params(DEPTH))
    with pytest.raises(ConvertError) as raised:
        export(tmp_path / "there", tmp_path / "out.safetensors")
    assert "channels of depth, which the public format does not know" in str(raised.value)


def test_the_small_preset_is_that_of_rgb_with_depth() -> None:
    rgb, depth = presets.get("irasim_tiny"), presets.get("irasim_rgbd_tiny")
    values = {"name": rgb.name, "model.autoencoder.depth": "none", "tokenizer_train.depth_share": 0.0}
    assert with_values(depth, values) == rgb
    assert depth.model.uses_depth and not rgb.model.uses_depth
    assert create_autoencoder(rgb).shapes() == create_autoencoder(depth).shapes()
    shapes = [jax.eval_shape(create_model(config).init, jax.random.key(0)) for config in (rgb, depth)]
    assert [count(each) for each in shapes] == [2_556_304, 2_560_416]
    one, other = (create_model(config).flops(16)["train"] for config in (rgb, depth))
    assert other / one == pytest.approx(1.002, abs=0.0005)
