"""The commands for IRASim and for SDXL's autoencoder, from files to files."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from rsjax.models.irasim.autoencoder import init
from rsjax.models.irasim.config import KLConfig
from rsjax.tools.convert.directory import load_irasim, load_kl_autoencoder
from rsjax.tools.convert.files import read_tensors, write_safetensors
from rsjax.tools.convert.kl_autoencoder import to_public
from tests.models.irasim import public, toy
from tests.tools.convert.test_commands import GENIE, assert_same, convert, refused

NET = public.Network()
SMALL = KLConfig(channels=8, channel_multipliers=(1, 2), res_blocks=1, norm_groups=4)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    path = tmp_path / "in.safetensors"
    write_safetensors(path, public.random_weights(NET), {})
    return path


@pytest.fixture
def vae(tmp_path: Path) -> Path:
    params = toy.drawn(jax.eval_shape(lambda key: init(SMALL, key), jax.random.key(0)))
    params["latents"] = {"mean": np.zeros(4, np.float32), "log_deviation": np.full(4, np.log(1 / 0.2), np.float32)}
    tensors, settings = to_public(SMALL, params)
    (tmp_path / "vae").mkdir()
    path = tmp_path / "vae" / "in.safetensors"
    write_safetensors(path, tensors, {})
    (tmp_path / "vae" / "config.json").write_text(json.dumps(settings))
    return path


def test_both_networks_come_back_through_one_directory(
    weights: Path, vae: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "own"
    convert("irasim", weights, own, "--heads", NET.heads)
    assert "left aside: 2 tensors of fixed positions" in capsys.readouterr().out
    convert("sdxl", vae, own)
    printed = capsys.readouterr().out
    assert "left aside: no tensors" in printed
    assert "have the factor 0.2; the public IRASim needs SDXL's, 0.13025" in printed
    convert("irasim", "--export", own, tmp_path / "out.safetensors")
    assert_same(tmp_path / "out.safetensors", public.random_weights(NET))
    convert("irasim", tmp_path / "out.safetensors", tmp_path / "again")
    assert load_irasim(tmp_path / "again")[0] == load_irasim(own)[0]
    config, params = load_kl_autoencoder(own)
    assert config == SMALL
    np.testing.assert_allclose(np.exp(-params["latents"]["log_deviation"]), 0.2, rtol=1e-5)
    convert("sdxl", "--export", own, tmp_path / "out" / "x.safetensors")
    assert json.loads((tmp_path / "out" / "config.json").read_text())["scaling_factor"] == 0.2
    names = set(read_tensors(tmp_path / "out" / "x.safetensors").tensors)
    assert names >= {  # as diffusers has them
        "quant_conv.weight",
        "encoder.down_blocks.0.resnets.0.conv1.weight",
        "encoder.down_blocks.0.downsamplers.0.conv.weight",
        "encoder.mid_block.resnets.1.norm2.bias",
        "decoder.mid_block.attentions.0.group_norm.weight",
        "decoder.mid_block.attentions.0.to_out.0.weight",
        "decoder.up_blocks.0.upsamplers.0.conv.bias",
        "decoder.conv_norm_out.weight",
    }


def test_files_of_something_else_are_refused(
    weights: Path, vae: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_safetensors(tmp_path / "genie.safetensors", GENIE, {})
    assert "genie.safetensors: holds no weights of an IRASim" in refused(
        capsys, "irasim", tmp_path / "genie.safetensors", tmp_path / "o"
    )
    assert "holds no AutoencoderKL" in refused(capsys, "sdxl", weights, tmp_path / "o")
    assert "of width 32, which is not a public size; set --heads" in refused(capsys, "irasim", weights, tmp_path / "o")
    tensors = public.random_weights(NET)
    del tensors["blocks.1.mlp.fc2.bias"]
    tensors["extra"] = np.zeros(1, np.float32)
    write_safetensors(weights, tensors, {})
    message = refused(capsys, "irasim", weights, tmp_path / "o", "--heads", 2)
    assert "missing: blocks.1.mlp.fc2.bias; unexpected: extra" in message
    (vae.parent / "config.json").write_text('{"_class_name": "AutoencoderTiny"}')
    assert "describes AutoencoderTiny, not AutoencoderKL" in refused(capsys, "sdxl", vae, tmp_path / "o")


def test_what_the_tensors_do_not_reveal_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def file(net: public.Network, **changes: np.ndarray) -> Path:
        write_safetensors(tmp_path / "x.safetensors", public.random_weights(net) | changes, {})
        return tmp_path / "x.safetensors"

    # 6 numbers and 4 frames: an action of 6 numbers, or 3 actions of 2.
    path = file(public.Network(depth=2, frames=4, actions=6))
    both = refused(capsys, "irasim", path, tmp_path / "o", "--heads", 2)
    assert "reads 6 numbers, which are one action or those of all 3 in a clip; set --conditioning frame or" in both
    for conditioning, inputs in (("frame", 6), ("video", 2)):
        convert("irasim", path, tmp_path / conditioning, "--heads", 2, "--conditioning", conditioning)
        made = load_irasim(tmp_path / conditioning)[0]
        assert (made.conditioning, made.action_inputs) == (conditioning, inputs)
    path = file(public.Network(depth=2, frames=4, actions=7))
    said = refused(capsys, "irasim", path, tmp_path / "o", "--heads", 2, "--conditioning", "video")
    assert "reads 7 numbers, which the 3 actions of a clip do not divide" in said
    convert("irasim", path, tmp_path / "whole", "--heads", 2, "--final-frame-ada")
    assert load_irasim(tmp_path / "whole")[0].final_frame_ada
    for name in ("pos_embed", "temp_embed"):
        shape = public.shapes(NET)[name]
        path = file(NET, **{name: np.ones(shape, np.float32)})
        assert f"{name} holds no sines and cosines" in refused(capsys, "irasim", path, tmp_path / "o", "--heads", 2)


def test_a_trained_autoencoder_has_no_public_form(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="cannot express model.autoencoder.network 'magvit2'"):
        to_public(toy.AUTOENCODER, toy.autoencoder_params(toy.config()))
    params = toy.drawn(jax.eval_shape(lambda key: init(SMALL, key), jax.random.key(0)))
    with pytest.raises(Exception, match="one factor for all latent channels"):
        to_public(replace(SMALL, kl_weight=0.0), params)


@pytest.mark.parametrize(
    ("options", "scale", "line"),
    [
        ((), 1.0, "read from the file's key ema\n"),
        (("--weights", "raw"), 2.0, "read from the file's key model\n"),
        ((), 2.0, "read from the file's key model, as it has no ema\n"),
    ],
)
def test_training_checkpoints_are_read_without_running_them(
    options: tuple[str, ...], scale: float, line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch = pytest.importorskip("torch")
    ema = {name: torch.from_numpy(x) for name, x in public.random_weights(NET).items()}
    fixed = ("pos_embed", "temp_embed")
    raw = {f"module.{name}": x if name in fixed else 2 * x for name, x in ema.items()}
    moments = {number: {"exp_avg": x} for number, x in enumerate(ema.values())}
    networks = {"model": raw} if "no ema" in line else {"model": raw, "ema": ema}
    torch.save(networks | {"opt": {"state": moments}, "args": None}, tmp_path / "0300000.pt")
    convert("irasim", tmp_path / "0300000.pt", tmp_path / "own", "--heads", NET.heads, *options)
    said = capsys.readouterr().out
    assert line in said
    for key in (networks.keys() | {"opt"}) - {"ema" if scale == 1 else "model"}:
        assert f"left aside: {len(ema)} tensors of the file's key {key}\n" in said
    kernel = load_irasim(tmp_path / "own")[1]["final"]["kernel"]
    np.testing.assert_allclose(kernel, scale * public.random_weights(NET)["final_layer.linear.weight"].T)
