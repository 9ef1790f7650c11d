"""CogVideoX through the stages of a run, and what its loss, its rollouts and its texts must and must not depend on."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy

from rsjax.clip import Video
from rsjax.config import ConfigError, presets, to_dict
from rsjax.config.config_fields import with_values
from rsjax.data.normalization import Normalization
from rsjax.errors import UserError
from rsjax.layers.cpu import convolution
from rsjax.models.base import Assets, create_autoencoder, create_model
from rsjax.models.cogvideox import causal_vae as vae
from rsjax.models.cogvideox.autoencoder import CausalCodec, filled
from rsjax.models.cogvideox.config import CogVideoXConfig, GuidedDenoiseConfig, TextConfig, latent_frames, padded_frames
from rsjax.models.cogvideox.model import latent_arrays
from rsjax.models.cogvideox.pretrained import saved_architecture
from rsjax.models.cogvideox.rollout import _chunk, rollout
from rsjax.models.cogvideox.text import check_tasks, read_texts, texts_of, write_texts
from rsjax.models.cogvideox.transformer import Architecture, forward_flops, shapes
from rsjax.models.diffusion.config import NoiseConfig
from rsjax.models.diffusion.schedule import alphas
from rsjax.tools.bench import inputs
from rsjax.tools.describe import describe
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.run_clips import on_store
from rsjax.tools.pipeline.stages import run_all, train_tokenizer
from rsjax.trainable import StepContext
from tests.models.cogvideox import toy
from tests.tools.pipeline.toy import store

CONFIG = toy.config()
MODEL: Any = create_model(CONFIG)
RNG = np.random.default_rng(0)


def test_weights_of_a_run_start_another_but_no_other_network(tmp_path: Path) -> None:
    for part in ("tokenizer", "world_model"):
        (tmp_path / part / "weights").mkdir(parents=True)
    (tmp_path / "config.json").write_text(json.dumps(to_dict(CONFIG)))
    for same in (MODEL, create_model(toy.config(unroll=2, remat="blocks", compute_dtype="bfloat16"))):
        assert same.pretrained_shapes(tmp_path).keys() == toy.params(MODEL.architecture).keys()
    for line, changes in (
        ("holds another network .width is 32 there, 64 here", {"width": 64}),
        ("model.text.width is 4 there, 5 here", {"text": TextConfig(width=5)}),
        ("model.image is channels there, first_latent here", {"image": "first_latent"}),
    ):
        with pytest.raises(UserError, match=line):
            create_model(toy.config(**changes)).pretrained_shapes(tmp_path)
    wider = replace(toy.AUTOENCODER, res_blocks=2)
    with pytest.raises(UserError, match="holds another network .res_blocks is 1 there, 2 here"):
        create_autoencoder(toy.config(autoencoder=wider)).pretrained_shapes(tmp_path)


def test_actions_change_nothing_and_the_padding_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    params, weights = toy.params(MODEL.architecture), toy.autoencoder_params(CONFIG)
    clips = store(tmp_path / "clips")
    source = clips.source("test")
    rgb, actions = (np.stack([source[number][name] for number in range(2)]) for name in ("rgb", "actions"))
    assets = Assets(Normalization.create(clips), weights)
    MODEL.prepare(clips, assets, tmp_path / "latents", 0.0)
    assert "clips of 6 frames are encoded as 9, 8k + 1, by repeating the last" in capsys.readouterr().out
    assert create_autoencoder(CONFIG).notes() == ["windows of 6 frames are encoded as 9, 8k + 1, by repeating the last"]
    assert create_autoencoder(with_values(CONFIG, {"tokenizer_train.frames_per_clip": 9})).notes() == []
    prompt = Video(rgb[:, :1], tasks=np.array(["drift"] * 2))
    one, other = (MODEL.generate(params, assets, prompt, actions + more).rgb for more in (0, 1))
    assert one.shape == rgb.shape
    np.testing.assert_array_equal(one, other)


def batch(clips: int = 3, **changes: Any) -> Any:
    return inputs.batch(create_model(toy.config(**changes)), toy.config(**changes), clips)


@cache
def compiled_terms(**changes: Any) -> Any:
    model: Any = create_model(toy.config(**changes))
    return jax.jit(lambda p, b: model.loss_terms(p, b, jax.random.key(0), StepContext(jnp.int32(0), None, None)))


def loss(params: Any, batch: Any, **changes: Any) -> Any:
    value, weight = compiled_terms(**changes)(params, batch)["error"]
    return value / weight


def test_padding_does_not_change_the_loss_and_image_and_text_do() -> None:
    params, clips = toy.params(MODEL.architecture), batch(2)
    whole = loss(params, clips)
    alone = {name: x[jnp.array([1, 1])] for name, x in clips.items()}
    padded = {name: x.at[0].set(x[1]) for name, x in clips.items()} | {"weight": jnp.array([0.0, 1.0])}
    padded["index"] = alone["index"]
    np.testing.assert_allclose(loss(params, padded), loss(params, alone), rtol=1e-5)
    assert abs(loss(params, clips | {"image": clips["image"] + 1}) / whole - 1) > 1e-4
    assert abs(loss(params, clips | {"text": 0 * clips["text"]}) / whole - 1) > 1e-4


def test_neither_remat_nor_unrolling_changes_loss_or_gradient() -> None:
    params, clips = toy.params(MODEL.architecture), batch(2)

    def made(**changes: Any) -> Any:
        return jax.jit(jax.value_and_grad(lambda p: loss(p, clips, **changes)))(params)

    plain = jax.tree.leaves(made())
    assert all(np.abs(x).max() > 0 for x in plain)
    for x, y in zip(jax.tree.leaves(made(unroll=2, remat="blocks")), plain, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-5 * np.abs(y).max())


def test_an_image_as_first_latent_is_clean_and_no_target() -> None:
    """With zeros for the velocity, the loss is the mean square of the target: the first frame's has no part in it."""
    changes: dict[str, Any] = {"image": "first_latent"}
    model: Any = create_model(toy.config(**changes))
    params = jax.tree.map(jnp.zeros_like, toy.params(model.architecture))
    clips = batch(2, **changes)
    whole = loss(params, clips, **changes)
    other = clips | {"latents": clips["latents"].at[:, 0].add(5), "image": clips["image"] + 5}
    np.testing.assert_allclose(loss(params, other, **changes), whole, rtol=1e-5)
    later = clips | {"latents": clips["latents"].at[:, 1].add(5)}
    assert loss(params, later, **changes) > 1.5 * whole


def test_loaders_draw_latents_images_and_texts() -> None:
    record = MODEL.example(RNG)
    draws = [latent_arrays(TextConfig(dropout=0.5), 0.25, record, np.random.default_rng(i)) for i in range(300)]
    latents = np.stack([drawn["latents"] for drawn in draws])
    np.testing.assert_allclose(latents.mean(0), record["mean"].astype(np.float32), atol=0.05)
    np.testing.assert_allclose(latents.std(0), record["deviation"].astype(np.float32), atol=0.03)
    assert np.mean([drawn["text"] == 0 for drawn in draws]) == pytest.approx(0.5, abs=0.1)
    kept = [drawn["image"] for drawn in draws if drawn["image"].any()]
    assert len(kept) / len(draws) == pytest.approx(0.75, abs=0.1)
    near = [np.abs(image - mean).mean() < 0.2 for mean in record["image_mean"] for image in kept]
    assert np.mean(near) == pytest.approx(1 / len(record["image_mean"]), abs=0.01)


def made(frames: int, index: tuple[int, ...] = (3, 4), prompt: Video | None = None) -> np.ndarray:
    arch = MODEL.architecture
    codec = CausalCodec(toy.AUTOENCODER, toy.autoencoder_params(CONFIG))
    given = inputs.video(CONFIG, len(index), 1) if prompt is None else prompt
    return rollout(arch, codec, CONFIG.clips.frames, toy.params(arch), given, frames, np.array(index))


def test_rollouts_keep_their_prompt_and_go_on_chunk_by_chunk() -> None:
    frames, video = CONFIG.clips.frames, inputs.video(CONFIG, 2, 2)
    short, long = made(frames), made(2 * frames)
    assert long.shape[1] == 2 * frames
    np.testing.assert_array_equal(long[:, :frames], short)
    codec = CausalCodec(toy.AUTOENCODER, toy.autoencoder_params(CONFIG))
    np.testing.assert_array_equal(short[:, :1], codec.decode(codec.encode(inputs.video(CONFIG, 2, 1))).rgb)
    other = made(frames, index=(3, 5))
    np.testing.assert_array_equal(other[0], short[0])
    assert (other[1, 1:] != short[1, 1:]).any()
    # Only the last frame of a prompt is read; a chunk that begins with it is the same.
    after = made(frames + 1, prompt=video)
    np.testing.assert_array_equal(after[:, 2:], made(frames, prompt=video.frames(1))[:, 1:])


def test_guidance_moves_away_from_the_empty_text() -> None:
    """The velocity is linear in the guidance, and so are the latents after one step of sampling."""
    image, index = RNG.normal(size=(2, 8, 8, 3)).astype(np.float32), np.arange(2)
    texts, empty = np.ones(2, np.int32), np.zeros(2, np.int32)

    def latents(guidance: float) -> np.ndarray:
        model = replace(toy.MODEL, sample=replace(toy.MODEL.sample, guidance=guidance, steps=1))
        arch = replace(MODEL.architecture, model=model)
        params = toy.params(MODEL.architecture)
        return np.asarray(_chunk(arch, params, jax.random.key(0), image, texts, empty, index))

    without, with_text = latents(0.0), latents(1.0)
    assert np.abs(with_text - without).max() > 3e-3
    np.testing.assert_allclose(latents(3.0), 3 * with_text - 2 * without, atol=1e-4)


def test_videos_are_filled_up_and_cut_again() -> None:
    assert [padded_frames(n) for n in (1, 2, 9, 10, 16, 17, 18, 49)] == [1, 9, 9, 17, 17, 17, 25, 49]
    assert [latent_frames(n) for n in (1, 9, 16, 49)] == [1, 3, 5, 13]
    codec = CausalCodec(toy.AUTOENCODER, toy.autoencoder_params(CONFIG))
    video = inputs.video(CONFIG, 2, 6)
    tokens = codec.encode(video)
    assert tokens["mean"].shape == (2, 3, 8, 8, 3)
    assert codec.decode(tokens).rgb.shape == video.rgb.shape
    whole = Video(filled(video.rgb, 1))
    np.testing.assert_array_equal(codec.encode(whole)["mean"], tokens["mean"])
    np.testing.assert_array_equal(codec.decode(tokens).rgb, codec.decode(codec.encode(whole)).rgb[:, :6])


HALVES = {half: jax.jit(getattr(vae, half), static_argnums=0) for half in ("encode", "decode")}
PIXELS = RNG.normal(size=(2, 17, 16, 16, 3)).astype(np.float32)  # in two pieces, as are the latents
INPUTS = {"encode": PIXELS, "decode": PIXELS[:, :5, :2, :2]}
LATER = {"encode": (9, 3), "decode": (3, 9)}  # frames in and out of the first piece


@pytest.mark.parametrize("half", HALVES)
def test_later_pieces_and_other_videos_change_no_frames(half: str) -> None:
    """The autoencoder is causal from piece to piece, and a piece reads the end of the one before."""
    params = toy.autoencoder_params(CONFIG)
    x = INPUTS[half]
    given, kept = LATER[half]
    index = np.arange(x.shape[1])[:, None, None, None]
    whole = HALVES[half](toy.AUTOENCODER, params, x)
    changed = HALVES[half](toy.AUTOENCODER, params, x + (index >= given))
    np.testing.assert_allclose(changed[:, :kept], whole[:, :kept], atol=1e-5)
    assert np.abs(changed[:, kept:] - whole[:, kept:]).max() > 1e-2
    early = HALVES[half](toy.AUTOENCODER, params, x + (index == given - 1))
    assert np.abs(early[:, kept] - whole[:, kept]).max() > 1e-4
    other = HALVES[half](toy.AUTOENCODER, params, x + np.arange(2)[:, None, None, None, None])
    np.testing.assert_array_equal(other[0], whole[0])
    assert np.abs(other[1] - whole[1]).max() > 1e-2


@pytest.mark.usefixtures("bf16_units")
@pytest.mark.parametrize("half", HALVES)
def test_bf16_rounds_the_autoencoders_convolutions(half: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(convolution, "LEAST", 4)
    params = toy.autoencoder_params(CONFIG)
    exact = HALVES[half](toy.AUTOENCODER, params, INPUTS[half])
    rough = HALVES[half](replace(toy.AUTOENCODER, compute_dtype="bfloat16"), params, INPUTS[half])
    assert 0 < np.abs(rough - exact).max() < 0.05 * np.abs(exact).max()


def test_the_schedule_ends_in_noise_and_shifts() -> None:
    plain = NoiseConfig(betas="scaled_linear", beta_start=0.00085, beta_end=0.012, prediction="velocity")
    left, zero = alphas(plain), alphas(replace(plain, zero_terminal=True))
    assert zero[-1] == 0 < left[-1]
    np.testing.assert_allclose(zero[0], left[0])
    shifted = alphas(replace(plain, snr_shift=3.0))
    np.testing.assert_allclose(shifted / (1 - shifted), left / (1 - left) / 3)
    with pytest.raises(ConfigError, match="model.noise.zero_terminal is on"):
        NoiseConfig(zero_terminal=True)


def test_counts_are_the_public_ones() -> None:
    def count(of: Any) -> int:
        return sum(x.size for x in jax.tree.leaves(of))

    large, small = presets.get("cogvideox_5b_i2v"), presets.get("cogvideox_2b")
    assert count(jax.eval_shape(create_model(large).init, jax.random.key(0))) == 5_570_479_680
    assert count(jax.eval_shape(create_model(small).init, jax.random.key(0))) == 1_693_783_872
    autoencoder = create_autoencoder(large).shapes()
    assert count(autoencoder["encoder"]) + count(autoencoder["decoder"]) == 215_583_907
    positions = saved_architecture(replace(CogVideoXConfig(), text=large.model.text, learned_positions=(13, 30, 45)))  # type: ignore[attr-defined]
    assert count(shapes(positions)) == 5_570_479_680 + (226 + 13 * 30 * 45) * 3072
    tiny = presets.get("cogvideox_tiny")
    assert forward_flops(Architecture.create(tiny.model, tiny.clips)) == pytest.approx(3.0e9, rel=0.01)  # type: ignore[arg-type]


def test_texts_come_from_a_file_or_are_learned(tmp_path: Path) -> None:
    file = tmp_path / "text.safetensors"
    made = RNG.normal(size=(3, 2, 4)).astype(np.float32)
    file.write_bytes(write_texts(["", "lift", "press"], made))
    text = TextConfig(file=str(file), tokens=2, width=4)
    np.testing.assert_array_equal(texts_of(text, ["press", "unknown"], 2), made[[2, 0]])
    np.testing.assert_array_equal(texts_of(text, None, 2), made[[0, 0]])
    with pytest.raises(UserError, match="no text of the task 'drift', only of 'lift', 'press'; make it with"):
        check_tasks(text, ["lift", "drift"])
    with pytest.raises(UserError, match="its texts have 2 tokens of 4 numbers, the model takes 226 of 4"):
        texts_of(replace(text, tokens=226), None, 1)
    with pytest.raises(UserError, match="absent: no such file of text embeddings; make it with rsjax convert"):
        texts_of(TextConfig(file=str(tmp_path / "absent")), None, 1)
    changed = bytearray(file.read_bytes())
    changed[-1] ^= 1
    (tmp_path / "changed").write_bytes(changed)
    with pytest.raises(UserError) as damaged:
        read_texts(str(tmp_path / "changed"), 2, 4)
    assert "its digest is wrong" in str(damaged.value)
    (tmp_path / "older").write_bytes(safetensors.numpy.save({"embeddings": made}, {"texts": '["", "lift", "press"]'}))
    np.testing.assert_array_equal(read_texts(str(tmp_path / "older"), 2, 4).embeddings, made)
    (tmp_path / "other").write_bytes(b"x")
    with pytest.raises(UserError, match="not a file of text embeddings, or damaged"):
        read_texts(str(tmp_path / "other"), 2, 4)
    for number, (names, bad) in enumerate(((["x", ""], made[:2]), ("5", made[:1]), ([""], made[:1] * np.nan))):
        (tmp_path / f"bad-{number}").write_bytes(write_texts(names, bad))  # a string is written as a list of characters
        with pytest.raises(
            UserError, match=r"holds no embeddings of texts, the empty one first|values that are not finite"
        ):
            read_texts(str(tmp_path / f"bad-{number}"), 2, 4)
    (tmp_path / "number").write_bytes(safetensors.numpy.save({"embeddings": made}, {"texts": "5"}))
    with pytest.raises(UserError, match="holds no embeddings of texts, the empty one first"):
        read_texts(str(tmp_path / "number"), 2, 4)
    learned = TextConfig(tasks=("lift", "press"))
    assert texts_of(learned, ["press", "unknown", "lift"], 3).tolist() == [2, 0, 1]
    assert texts_of(TextConfig(), ["whatever"], 1).tolist() == [1]
    with pytest.raises(UserError, match="model.text.tasks: no text of the task 'x'"):
        texts_of(learned, ["x"], 1)


def test_a_task_without_a_text_reads_the_empty_one_and_a_note_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Clips of an unseen task are generated too, and an empty text that was not trained is not read in silence."""
    seen: list[Any] = []

    def chunk(arch: Any, params: Any, key: Any, image: Any, texts: Any, *_: Any) -> np.ndarray:
        seen.append(np.asarray(texts))
        return np.zeros((len(image), arch.frames, *image.shape[1:]), np.float32)

    monkeypatch.setattr("rsjax.models.cogvideox.rollout._chunk", chunk)
    codec = CausalCodec(toy.AUTOENCODER, toy.autoencoder_params(CONFIG))

    def shown(text: TextConfig, *tasks: str) -> tuple[Any, str]:
        arch = replace(MODEL.architecture, model=replace(toy.MODEL, text=text, sample=GuidedDenoiseConfig(guidance=1)))
        prompt = replace(inputs.video(CONFIG, 2, 1), tasks=np.array(tasks) if tasks else None)
        rollout(arch, codec, CONFIG.clips.frames, {}, prompt, CONFIG.clips.frames, np.arange(2))
        return seen[-1], capsys.readouterr().out

    learned = TextConfig(tokens=2, width=4, tasks=("lift", "press"), dropout=0.0)
    rows, said = shown(learned, "press", "push")
    assert rows.tolist() == [2, 0]
    assert "model.text.tasks: no text of the task 'push', only of 'lift', 'press': it reads the empty text, " in said
    rows, said = shown(learned)
    assert rows.tolist() == [0, 0]
    untrained = "which training without model.text.dropout shows only for clips without a task"
    assert f"a clip has no task: it reads the empty text, {untrained}" in said
    assert shown(learned, "press", "push")[1] == "", "once is enough"
    assert shown(replace(learned, dropout=0.1))[1] == ""
    file = tmp_path / "text.safetensors"
    embeddings = RNG.normal(size=(2, 2, 4)).astype(np.float32)
    file.write_bytes(write_texts(["", "lift"], embeddings))
    rows, said = shown(TextConfig(file=str(file), tokens=2, width=4, dropout=0.0), "lift", "push")
    np.testing.assert_array_equal(rows, embeddings[[1, 0]])
    assert f"only of 'lift': it reads the empty text; {file} can be made again with --task 'push' too" in said


def test_a_task_without_a_text_is_an_error_before_the_autoencoder_is_trained(tmp_path: Path) -> None:
    text = replace(toy.MODEL.text, tasks=("lift",))
    clips = store(tmp_path / "clips", label=lambda record: {"task": record["task"]})
    run = Run(on_store(toy.config(text=text), clips.path), tmp_path / "run", tmp_path)
    with pytest.raises(UserError, match="model.text.tasks: no text of the task 'drift', only of 'lift'; name it there"):
        train_tokenizer(run, resume=True)
    assert not run.directory.exists()


def test_shapes_need_no_file_of_texts() -> None:
    text = TextConfig(file="absent.safetensors", tokens=2, width=4, dropout=0.3)
    assert describe(toy.config(text=text)).figures["bytes_activations_per_clip"] > 0


def test_a_missing_file_of_texts_is_an_error_before_anything_is_simulated(tmp_path: Path) -> None:
    text = replace(toy.MODEL.text, file=str(tmp_path / "absent"))
    run = Run(toy.config(text=text), tmp_path / "run", tmp_path / "data")
    with pytest.raises(UserError, match="absent: no such file of text embeddings; make it with"):
        run_all(run)
    assert not run.clips.exists() and not run.mark("collect")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"patch_size": 3}, "images have 64 pixels a side, which the 24 pixels of a token .* take clips of 48 or 72"),
        ({"learned_positions": (13, 30, 45)}, "model.learned_positions are for .13, 30, 45. frames"),
        ({"text": TextConfig(dropout=0.0)}, "model.sample.guidance is 2.0, but the learned tokens of the empty text"),
        ({"heads": 4}, "model.width is 32; .* the channels of a head by 16"),
        ({"image": "first_latent", "image_dropout": 0.1}, "model.image_dropout is above 0"),
    ],
)
def test_impossible_settings_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        toy.config(**changes)
