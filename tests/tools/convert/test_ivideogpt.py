"""iVideoGPT's public files, in and out."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from rsjax.config import ClipShape
from rsjax.models.ivideogpt.config import ConditionalVQConfig, IVideoGPTConfig
from rsjax.models.ivideogpt.llama import Architecture, LLaMA
from rsjax.models.ivideogpt.model import IVideoGPT
from rsjax.models.network_settings import Inputs
from rsjax.tools.convert.directory import save_part
from rsjax.tools.convert.files import write_safetensors
from rsjax.tools.convert.ivideogpt import llama_table, tokenizer_shapes, tokenizer_table
from rsjax.tools.convert.table import public_shapes, to_params
from rsjax.training.checkpoint import load_weights
from tests.tools.convert.public import Tensors, random_tensors
from tests.tools.convert.test_commands import assert_same, convert, refused

VQ = ConditionalVQConfig(widths=(32, 32), res_blocks=1, latent=8, codes=16, attention_size=8)
LLAMA = IVideoGPTConfig(autoencoder=VQ, width=64, blocks=2, heads=1, mlp_width=32)
CLIPS = ClipShape(frames=4, image_size=16, tracks=1, action_dim=3, test_clips=2)


def tokenizer_tensors() -> Tensors:
    shapes = tokenizer_shapes(VQ, CLIPS.image_size)
    return random_tensors(public_shapes(tokenizer_table(shapes), shapes))


def llama_tensors(config: IVideoGPTConfig = LLAMA) -> Tensors:
    shapes = jax.eval_shape(LLaMA(Architecture.create(config, CLIPS)).init_params, jax.random.key(0))
    return random_tensors(public_shapes(llama_table(config), shapes))


TOKENIZER = tokenizer_tensors()
TRANSFORMER = llama_tensors()


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    paths = {name: tmp_path / f"{name}.safetensors" for name in ("tokenizer", "world_model")}
    write_safetensors(paths["tokenizer"], TOKENIZER, {})
    write_safetensors(paths["world_model"], TRANSFORMER | {"reward_linear.weight": np.ones((1, 64))}, {})
    return paths


def test_one_directory_holds_both_parts_and_exports_each_to_the_bit(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for part in ("world_model", "tokenizer"):  # and below the other way round
        convert("ivideogpt", files[part], tmp_path / "own")
    said = capsys.readouterr().out
    assert f"a tokenizer of {len(TOKENIZER)} tensors" in said
    assert f"a transformer of {len(TRANSFORMER)} tensors" in said
    assert "left aside: 1 tensor of reward_linear" in said and "left aside: no tensors" in said
    settings = json.loads((tmp_path / "own" / "config.json").read_text())
    assert settings["inputs"] == {"image_size": 16, "action_dim": 3}
    for part, tensors in (("tokenizer", TOKENIZER), ("world_model", TRANSFORMER)):
        out = tmp_path / "out" / f"{part}.safetensors"
        convert("ivideogpt", "--export", tmp_path / "own", out, "--part", part)
        assert_same(out, tensors)
        convert("ivideogpt", out, tmp_path / "again")
    assert json.loads((tmp_path / "again" / "config.json").read_text()) == settings
    assert "name one with --part" in refused(
        capsys, "ivideogpt", "--export", tmp_path / "own", tmp_path / "x.safetensors"
    )


def test_weights_without_actions_start_a_model_with_actions_that_changes_nothing(tmp_path: Path) -> None:
    alone = replace(LLAMA, use_actions=False)
    tensors = llama_tensors(alone)
    assert "model.norm.weight" in tensors
    write_safetensors(tmp_path / "in.safetensors", tensors, {})
    convert("ivideogpt", tmp_path / "in.safetensors", tmp_path / "own")
    model = IVideoGPT(LLAMA, CLIPS)
    shapes = model.pretrained_shapes(tmp_path / "own")
    saved = load_weights(tmp_path / "own" / "world_model" / "weights", shapes)
    started = model.start(jax.jit(model.init)(jax.random.key(0)), saved, tmp_path / "own")
    tokens = np.arange(20)[None]
    actions = np.ones((1, 3, 3), np.float32)
    mine, _ = LLaMA(model.architecture).apply({"params": started}, tokens, actions)
    theirs, _ = LLaMA(Architecture.create(alone, CLIPS)).apply({"params": saved}, tokens, None)
    np.testing.assert_array_equal(mine, theirs)


def test_a_model_without_actions_of_clips_that_have_some_comes_back(tmp_path: Path) -> None:
    alone = replace(LLAMA, use_actions=False)
    shapes = jax.eval_shape(LLaMA(Architecture.create(alone, CLIPS)).init_params, jax.random.key(0))
    params = to_params("", llama_tensors(alone), llama_table(alone), shapes)
    save_part(tmp_path / "own", "world_model", alone, Inputs(CLIPS.image_size, CLIPS.action_dim), params)
    convert("ivideogpt", "--export", tmp_path / "own", tmp_path / "out.safetensors")
    convert("ivideogpt", tmp_path / "out.safetensors", tmp_path / "again")
    old, new = (json.loads((tmp_path / name / "config.json").read_text()) for name in ("own", "again"))
    assert new["inputs"] == old["inputs"] and new["model"]["use_actions"] is False


def test_files_that_do_not_fit_are_refused(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def message(tensors: Tensors, out: str = "new", *more: object) -> str:
        write_safetensors(tmp_path / "bad.safetensors", tensors, {})
        return refused(capsys, "ivideogpt", tmp_path / "bad.safetensors", tmp_path / out, *more)

    assert "holds no LLaMA of iVideoGPT, such as model.layers.0" in message({"encoder.weight": np.ones(3)})
    lacking = {name: x for name, x in TOKENIZER.items() if name != "quant_conv.bias"}
    assert "missing: quant_conv.bias" in message(lacking)
    assert "model.width 64 is not divisible by 2 × model.heads (5)" in message(TRANSFORMER, "new", "--heads", 5)
    convert("ivideogpt", files["tokenizer"], tmp_path / "own")
    more = IVideoGPTConfig(autoencoder=ConditionalVQConfig(widths=(32, 32), codes=8), width=64, blocks=2, heads=1)
    assert "holds a part of an iVideoGPT with 16 codes, this one has 8" in message(llama_tensors(more), "own")
    assert not (tmp_path / "new").exists()
