"""Tests saved models: what is loaded generates as what was saved, and damage is named."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import safetensors.numpy

import rsjax
from rsjax.clip import Video
from rsjax.errors import UserError
from rsjax.model_directory import PRETRAINED, digests, locate, output_directory
from rsjax.models.trained import TrainedModel
from rsjax.tools.convert.directory import load_tokenizer, load_world_model
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.stages import pretrained_start
from tests.models.toy_family import ToyConfig
from tests.tools.pipeline import toy


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> TrainedModel:
    return toy.trained(toy.store(tmp_path_factory.mktemp("saved") / "clips"))


def assert_same(one: Any, other: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def generated(model: TrainedModel) -> Video:
    clip = toy.clip(7)
    assert clip.depth is not None
    return model.generate(clip.rgb[:1], clip.actions, depth=clip.depth[:1])


def test_a_saved_model_comes_back_and_generates_the_same(model: TrainedModel, tmp_path: Path) -> None:
    model.save(tmp_path / "mine")
    assert sorted(path.name for path in (tmp_path / "mine").iterdir()) == [
        "README.md",
        "config.json",
        "model.safetensors",
    ]
    loaded = rsjax.load(tmp_path / "mine")
    assert (loaded.config, loaded.model) == (model.config, model.model)
    assert loaded.assets.normalization == model.assets.normalization
    assert_same((loaded.params, loaded.assets.tokenizer), (model.params, model.assets.tokenizer))
    np.testing.assert_array_equal(generated(loaded).rgb, generated(model).rgb)
    card = (tmp_path / "mine" / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: rsjax\n")
    assert 'rsjax.load("mine")' in card
    assert "## Limits and misuse" in card


def test_a_model_is_shown_in_one_line(model: TrainedModel, tmp_path: Path) -> None:
    count = sum(x.size for x in jax.tree.leaves(model.params))
    shown = repr(replace(model, directory=tmp_path))
    assert (
        shown == f"TrainedModel('debug', roboscape, {count:,} parameters, clips of 6 frames of 64 pixels, {tmp_path})"
    )


def test_half_precision_rounds_each_parameter_once_and_halves_the_file(model: TrainedModel, tmp_path: Path) -> None:
    model.save(tmp_path / "whole")
    model.save(tmp_path / "half", "float16")
    loaded = rsjax.load(tmp_path / "half")
    rounded = jax.tree.map(lambda x: np.asarray(x).astype(np.float16).astype(x.dtype), model.params)
    assert_same(loaded.params, rounded)
    sizes = [(tmp_path / name / "model.safetensors").stat().st_size for name in ("half", "whole")]
    assert sizes[0] < 0.56 * sizes[1]  # names and shapes are as long in both
    again = tmp_path / "again"
    loaded.save(again, "float16")
    assert (again / "model.safetensors").read_bytes() == (tmp_path / "half" / "model.safetensors").read_bytes()


def test_a_value_that_half_precision_cannot_hold_is_refused(model: TrainedModel, tmp_path: Path) -> None:
    large = replace(model, params=jax.tree.map(lambda x: x * 0 + 1e5, model.params))
    with pytest.raises(UserError) as caught:
        large.save(tmp_path / "large", "float16")
    assert "has values that float16 cannot hold; save it as float32" in str(caught.value)


def flip_a_bit(path: Path) -> None:
    content = bytearray((path / "model.safetensors").read_bytes())
    content[-100] ^= 1
    (path / "model.safetensors").write_bytes(content)


def leave_a_pointer(path: Path) -> None:
    (path / "model.safetensors").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")


def without(name: str) -> Callable[[Path], None]:
    def remove(path: Path) -> None:
        settings = json.loads((path / "config.json").read_text())
        settings["saved"].pop(name)
        (path / "config.json").write_text(json.dumps(settings))

    return remove


def rename_a_tensor(path: Path) -> None:
    """Leaves a file whose digest is right and whose content is not."""
    file = path / "model.safetensors"
    tensors = safetensors.numpy.load_file(file)
    tensors["world_model/else"] = tensors.pop(max(name for name in tensors if name.startswith("world_model")))
    safetensors.numpy.save_file(tensors, file)
    settings = json.loads((path / "config.json").read_text())
    settings["saved"]["files"] = digests(path, ["model.safetensors"])
    (path / "config.json").write_text(json.dumps(settings))


DAMAGE: dict[str, tuple[Callable[[Path], None], str]] = {
    "flipped bit": (flip_a_bit, "model.safetensors: damaged: its SHA-256 is not the one that config.json records"),
    "pointer": (leave_a_pointer, "model.safetensors: a Git-LFS pointer in place of the file: fetch it with git lfs"),
    "no digests": (without("files"), "config.json: has no section 'saved' with digests of files"),
    "no normalization": (without("normalization"), "config.json: its normalization is damaged"),
    "other tensor": (rename_a_tensor, "the configuration needs none; copy it again"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_named_with_the_file(name: str, model: TrainedModel, tmp_path: Path) -> None:
    damage, message = DAMAGE[name]
    model.save(tmp_path / "mine")
    damage(tmp_path / "mine")
    with pytest.raises(UserError) as caught:
        rsjax.load(tmp_path / "mine")
    assert message in str(caught.value)
    assert str(tmp_path / "mine") in str(caught.value)


def test_saving_replaces_a_saved_model_and_nothing_else(model: TrainedModel, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    model.save(tmp_path / "mine", card="one")
    (tmp_path / "mine" / "clips").mkdir()
    model.save(tmp_path / "mine", card="two")
    assert (tmp_path / "mine" / "README.md").read_text() == "two"
    assert not (tmp_path / "mine" / "clips").exists()
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.png").touch()
    with pytest.raises(UserError) as caught:
        model.save(tmp_path / "photos")
    assert "holds something else than a saved model" in str(caught.value)
    with pytest.raises(UserError) as caught:
        Run(model.config, tmp_path / "mine", tmp_path).prepare(overwrite=True)
    assert "is a saved model; train in another --run-dir" in str(caught.value)


def test_training_and_conversion_start_from_a_saved_model_as_from_a_run(model: TrainedModel, tmp_path: Path) -> None:
    model.save(tmp_path / "mine")
    start = pretrained_start(model.model, str(tmp_path / "mine"), "world_model")
    assert start is not None
    assert_same(start(jax.tree.map(np.zeros_like, model.params)), model.params)
    assert load_tokenizer(tmp_path / "mine")[0] == model.config.tokenizer
    assert_same(load_world_model(tmp_path / "mine")[1], model.params)


def test_a_model_without_a_tokenizer_is_saved_too(model: TrainedModel, tmp_path: Path) -> None:
    bare = toy.trained(toy.store(tmp_path / "clips"), replace(toy.config(), model=ToyConfig()))
    bare.save(tmp_path / "bare")
    assert rsjax.load(tmp_path / "bare").assets.tokenizer is None


def test_a_name_is_a_directory_here_or_a_model_of_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert locate("runs/tiny") == Path("runs/tiny")
    assert output_directory(PRETRAINED / "tiny", "play") == Path("runs/tiny/play")
    assert output_directory(Path("mine"), "play") == Path("mine/play")
    (tmp_path / "multitask").mkdir()
    assert locate("multitask") == Path("multitask")
