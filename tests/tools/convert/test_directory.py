"""Directories of converted checkpoints: what is saved comes back, and what is missing or damaged is named."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.config import ModelConfig, TokenizerConfig, families, presets, to_dict
from rsjax.errors import UserError
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.transformer import Transformer
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tools.convert import directory
from rsjax.tools.convert.directory import load_tokenizer, load_world_model, save
from rsjax.tools.convert.files import ConvertError

MODEL = Architecture(frames=3, grid=2, code_bits=4, action_inputs=0, width=8, blocks=2, heads=2, depth="none")
TOKENIZER = TokenizerConfig(
    patch_size=2, channels=8, channel_multipliers=(1, 2), res_blocks=1, norm_groups=4, code_bits=6
)


def random_params(network: Tokenizer | Transformer) -> Any:
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(network.init_params, jax.random.key(0))
    return jax.tree.map(lambda x: rng.normal(scale=0.4, size=x.shape).astype(np.float32), shapes)


def test_a_run_directory_is_never_written_to(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps(to_dict(presets.debug())))
    with pytest.raises(ConvertError, match="is a run directory; choose another one"):
        save(tmp_path, MODEL, random_params(Transformer(MODEL)))


@pytest.mark.parametrize("load", [load_world_model, load_tokenizer])
def test_what_is_missing_or_damaged_is_named(load: Callable[[Path], Any], tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    for text, message in (
        (None, "config.json: missing; make it with rsjax convert"),
        ("{", str(path)),
        ("[]", str(path)),
        ("{}", f"{tmp_path}: holds no (world_model|tokenizer)/weights with their settings"),
    ):
        if text is not None:
            path.write_text(text)
        with pytest.raises(UserError, match=message):
            load(tmp_path)


@pytest.mark.parametrize(("settings", "message"), [([], "fields by name"), ({"odd": 3}, "no field odd")])
def test_damaged_settings_are_refused_beside_sound_weights(settings: Any, message: str, tmp_path: Path) -> None:
    save(tmp_path, TOKENIZER, random_params(Tokenizer(TOKENIZER)))
    (tmp_path / "config.json").write_text(json.dumps({"tokenizer": settings, "architecture": settings}))
    for name, load in (("tokenizer", load_tokenizer), ("world model", load_world_model)):
        with pytest.raises(UserError, match=f"config.json: the {name}'s settings cannot be read .*{message}"):
            load(tmp_path)  # type: ignore[operator]


def test_a_run_of_a_family_that_is_not_this_network_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True)
    class Pixels(ModelConfig):
        family = "pixels"

    monkeypatch.setitem(families(), "pixels", Pixels)
    (tmp_path / "config.json").write_text(json.dumps(to_dict(replace(presets.debug(), model=Pixels()))))
    with pytest.raises(UserError, match="holds a model of family 'pixels'; start from one of family robo"):
        load_world_model(tmp_path)


def test_a_network_whose_replacement_stopped_half_way_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tokenizer = random_params(Tokenizer(TOKENIZER))
    save(tmp_path, TOKENIZER, tokenizer)
    save(tmp_path, MODEL, random_params(Transformer(MODEL)))

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(directory, "save_weights", stop)
    with pytest.raises(KeyboardInterrupt):
        save(tmp_path, replace(MODEL, heads=4), {})
    with pytest.raises(UserError, match="holds no world_model/weights with their settings"):
        load_world_model(tmp_path)
    jax.tree.map(np.testing.assert_array_equal, load_tokenizer(tmp_path)[1], tokenizer)
