"""The commands for CogVideoX and its texts, from files to files."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.errors import UserError
from rsjax.models.base import create_model
from rsjax.models.cogvideox.autoencoder import init
from rsjax.models.cogvideox.config import CausalVAEConfig, CogVideoXConfig, TextConfig
from rsjax.models.cogvideox.pretrained import completed, saved_architecture
from rsjax.models.cogvideox.text import read_texts
from rsjax.models.cogvideox.transformer import shapes
from rsjax.models.network_settings import read_model
from rsjax.tools.convert import cogvideox
from rsjax.tools.convert.files import Tensors, write_safetensors
from rsjax.tools.convert.table import to_tensors
from rsjax.training.checkpoint import load_weights
from tests.models.cogvideox import toy
from tests.models.irasim.toy import drawn
from tests.tools.convert.test_commands import GENIE, assert_same, convert, refused

VAE = replace(toy.AUTOENCODER, patch_size=1)
NET = replace(toy.MODEL, autoencoder=VAE, text=TextConfig("text.safetensors", tokens=2, width=4))


def transformer(config: CogVideoXConfig) -> Tensors:
    return to_tensors(drawn(shapes(saved_architecture(config))), cogvideox.transformer_table(config))


def autoencoder() -> tuple[Tensors, dict[str, Any]]:
    params = drawn(jax.eval_shape(lambda key: init(VAE, key), jax.random.key(0)))
    factor = np.full(3, -np.log(0.25), np.float32)
    params["latents"] = {"mean": np.zeros(3, np.float32), "log_deviation": factor}
    settings = cogvideox.autoencoder_settings(VAE, params)
    networks = {n: params[n] for n in ("encoder", "decoder")}
    return to_tensors(networks, cogvideox.autoencoder_table(networks)), settings


def written(folder: Path, tensors: Tensors, settings: dict[str, Any] | None) -> Path:
    folder.mkdir()
    write_safetensors(folder / "in.safetensors", tensors, {})
    if settings:
        (folder / "config.json").write_text(json.dumps(settings))
    return folder / "in.safetensors"


def test_both_networks_come_back_to_the_bit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = replace(NET, learned_positions=(3, 2, 5))
    tensors = transformer(config)
    (vae, settings) = autoencoder()
    convert("cogvideox", written(tmp_path / "a", tensors, cogvideox.transformer_settings(config)), tmp_path / "own")
    convert("cogvideox", written(tmp_path / "b", vae, settings), tmp_path / "own")
    out = capsys.readouterr().out
    assert f"a transformer of {len(tensors)} tensors" in out
    assert f"an autoencoder of {len(vae)} tensors" in out and out.count("left aside: no tensors") == 2
    saved = read_model(tmp_path / "own", CogVideoXConfig, "world_model")
    assert saved.autoencoder == CausalVAEConfig(latent_channels=3, widths=(8, 8, 8), res_blocks=1, norm_groups=4)
    assert replace(saved, autoencoder=VAE, sample=config.sample, text=config.text) == config
    of = jax.eval_shape(lambda key: init(VAE, key), jax.random.key(0))
    latents = load_weights(tmp_path / "own" / "tokenizer" / "weights", of)["latents"]
    np.testing.assert_allclose(np.exp(-latents["log_deviation"]), 0.25, rtol=1e-5)
    for part, expected, beside in (
        ("world_model", tensors, cogvideox.transformer_settings(config)),
        ("tokenizer", vae, settings),
    ):
        (tmp_path / part).mkdir()
        convert("cogvideox", "--export", tmp_path / "own", tmp_path / part / "x.safetensors", "--part", part)
        assert_same(tmp_path / part / "x.safetensors", expected)
        assert json.loads((tmp_path / part / "config.json").read_text()) == beside
    assert "holds tokenizer and world_model; name one with --part" in refused(
        capsys, "cogvideox", "--export", tmp_path / "own", tmp_path / "x.safetensors"
    )

    # A model without learned positions starts from it, and one with others does not.
    plain: Any = create_model(toy.config())
    assert "learned_positions" in plain.pretrained_shapes(tmp_path / "own")
    fits = toy.config(learned_positions=(3, 4, 4))
    with pytest.raises(UserError, match="model.learned_positions is .3, 2, 5. there, .3, 4, 4. here"):
        create_model(fits).pretrained_shapes(tmp_path / "own")


def test_networks_in_several_files_are_read_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ("x-00001-of-00002.safetensors", "x-00002-of-00002.safetensors")
    tensors = transformer(NET)
    tensors["patch_embed.pos_embedding"] = np.zeros((1, 14, 32), np.float32)
    keys = sorted(tensors)
    for name, part in zip(names, (keys[::2], keys[1::2]), strict=True):
        write_safetensors(tmp_path / name, {key: tensors[key] for key in part}, {})
    (tmp_path / "config.json").write_text(json.dumps(cogvideox.transformer_settings(NET)))
    convert("cogvideox", tmp_path / names[1], tmp_path / "own")
    out = capsys.readouterr().out
    assert f"a transformer of {len(tensors) - 1} tensors" in out
    assert "left aside: 1 tensor of fixed positions" in out
    (tmp_path / names[0]).unlink()
    assert f"{names[0]}: no such file" in refused(capsys, "cogvideox", tmp_path / names[1], tmp_path / "own")


def test_a_network_without_channels_for_an_image_gets_empty_ones() -> None:
    saved = replace(NET, image="first_latent")
    own = NET
    fresh, there = (drawn(shapes(saved_architecture(config))) for config in (own, saved))
    begun = completed(fresh, there)["patches"]["kernel"]
    np.testing.assert_array_equal(begun[:, :, :3], there["patches"]["kernel"])
    assert not begun[:, :, 3:].any()


def test_files_of_something_else_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vae, settings = autoencoder()
    net = transformer(NET)
    own = cogvideox.transformer_settings(NET)
    newer = net | {"patch_embed.proj.weight": np.zeros((32, 96), np.float32)}
    misfit = vae | {"extra": np.zeros(1, np.float32)}
    del misfit["encoder.conv_out.conv.bias"]
    wrong: tuple[tuple[Tensors, dict[str, Any] | None, str], ...] = (
        (GENIE, None, "holds no network of CogVideoX, such as"),
        (newer, None, "has 2 axes, as in CogVideoX 1.5; pass 1.0's"),
        (vae, own, "is no CogVideoXTransformer3DModel"),
        (vae, {"_class_name": "AutoencoderKL"}, "describes AutoencoderKL, not"),
        (vae, settings | {"scaling_factor": 0}, "its config.json: scaling_factor is 0, not above 0"),
        (vae, settings | {"scaling_factor": True}, "scaling_factor is true, not a number"),
        (vae, settings | {"norm_num_groups": "32"}, 'norm_num_groups is "32", not a whole number'),
        (net, own | {"use_rotary_positional_embeddings": "false"}, 'embeddings is "false", not true or false'),
        (net, own | {"max_text_seq_length": -1}, "max_text_seq_length is -1, not above 0"),
        (misfit, settings, "missing: encoder.conv_out.conv.bias; unexpected: extra"),
    )
    for number, (tensors, beside, message) in enumerate(wrong):
        path = written(tmp_path / str(number), tensors, beside)
        assert message in refused(capsys, "cogvideox", path, tmp_path / "o")
    wide = replace(NET, autoencoder=replace(VAE, latent_channels=4))
    convert("cogvideox", written(tmp_path / "wide", transformer(wide), None), tmp_path / "o")
    path = written(tmp_path / "vae", vae, settings)
    assert "holds a part with 4 latent channels, this one has 3" in refused(capsys, "cogvideox", path, tmp_path / "o")


def test_trained_networks_have_no_public_form() -> None:
    with pytest.raises(UserError, match="the public format has neither model.autoencoder.patch_size above 1"):
        cogvideox.autoencoder_settings(toy.AUTOENCODER, toy.autoencoder_params(toy.config()))
    with pytest.raises(UserError, match="no name for these parts of the network: task_tokens"):
        transformer(toy.MODEL)


def test_texts_need_a_directory_and_tasks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "text.safetensors"
    assert "there are no tasks to embed; name them with --task" in refused(capsys, "text", tmp_path, out)
    refusal = refused(capsys, "text", tmp_path, out, "--task", "lift")
    assert "needs transformers and PyTorch" in refusal or "has no directory text_encoder" in refusal


def test_texts_are_those_of_the_encoder(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    transformers = pytest.importorskip("transformers")
    tokenizers = pytest.importorskip("tokenizers")
    words = {"<pad>": 0, "</s>": 1, "<unk>": 2, "lift": 3, "the": 4, "cube": 5}
    backend = tokenizers.Tokenizer(tokenizers.models.WordLevel(words, unk_token="<unk>"))
    backend.pre_tokenizer = tokenizers.pre_tokenizers.Whitespace()
    special = {"pad_token": "<pad>", "eos_token": "</s>", "unk_token": "<unk>"}
    tokenizer = transformers.PreTrainedTokenizerFast(tokenizer_object=backend, **special)
    tokenizer.save_pretrained(tmp_path / "tokenizer")
    sizes = {"d_model": 8, "d_kv": 4, "d_ff": 16, "num_layers": 1, "num_heads": 2, "vocab_size": 6}
    torch.manual_seed(0)
    encoder = transformers.T5EncoderModel(transformers.T5Config(**sizes)).eval()
    encoder.save_pretrained(tmp_path / "text_encoder")
    out = tmp_path / "text.safetensors"
    convert("text", tmp_path, out, "--task", "lift the cube", "--task", "lift", "--tokens", 5)
    names, embeddings = read_texts(str(out), 5, 8)
    assert names == ("", "lift the cube", "lift")
    with torch.no_grad():
        expected = encoder(torch.tensor([[3, 4, 5, 0, 0]]))[0].numpy()
    np.testing.assert_allclose(embeddings[1:2], expected, atol=1e-6)
