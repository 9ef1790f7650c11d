"""Weights that do not fit are refused in one line before anything is trained; it names files, fields and the cure."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rsjax.config import Config, ConfigError, presets, to_dict
from rsjax.config.config_fields import with_values
from rsjax.errors import UserError
from rsjax.models.base import create_autoencoder, create_model
from rsjax.models.irasim.config import KLConfig
from tests.models import families

GENIE, IVIDEOGPT, IRASIM, COGVIDEOX = (make() for make in families.FAMILIES.values())
SDXL = presets.get("irasim_s")


def world_model(config: Config, directory: Path) -> Any:
    return create_model(config).pretrained_shapes(directory)


def tokenizer(config: Config, directory: Path) -> Any:
    return create_autoencoder(config).pretrained_shapes(directory)


def saved(directory: Path, settings: Any) -> Path:
    """A directory with these settings; what the weights are is not looked at."""
    for part in ("tokenizer", "world_model"):
        (directory / part / "weights").mkdir(parents=True)
    (directory / "config.json").write_text(json.dumps(settings))
    return directory


@pytest.mark.parametrize(
    ("read", "config", "settings", "line"),
    [
        # of another family
        (world_model, GENIE, to_dict(IRASIM), "config.json: holds a model of family 'irasim'; .* family roboscape or"),
        (world_model, IVIDEOGPT, to_dict(GENIE), "config.json: holds a model of family 'genie'; .* family ivideogpt"),
        (world_model, IRASIM, {"model": to_dict(IVIDEOGPT.model), "inputs": {}}, "holds a model of family 'ivideogpt'"),
        (tokenizer, COGVIDEOX, to_dict(IRASIM), "holds a model of family 'irasim'; .* family cogvideox"),
        (tokenizer, IRASIM, to_dict(COGVIDEOX), "holds a model of family 'cogvideox'; .* family irasim"),
        (world_model, GENIE, {"irasim": {}}, "holds no world_model/weights with their settings"),
        (tokenizer, GENIE, to_dict(IVIDEOGPT), "its tokenizer is that of the family 'ivideogpt'; .* MAGVIT-2's"),
        (tokenizer, GENIE, {"kl_autoencoder": {}}, "holds no tokenizer/weights with their settings"),
        (tokenizer, IVIDEOGPT, to_dict(GENIE), "config.json: holds a model of family 'genie'; .* family ivideogpt"),
        # something else in place of SDXL's autoencoder
        (
            tokenizer,
            SDXL,
            {"tokenizer": {}},
            "describes no network of IRASim but tokenizer; .*convert sdxl",
        ),
        (tokenizer, SDXL, {"kl_autoencoder": {"channels": "x"}}, "config.json: .*channels must be .*; make it again"),
        (
            tokenizer,
            SDXL,
            {"kl_autoencoder": to_dict(KLConfig(latent_channels=16))},
            "holds another autoencoder .latent_channels is 16 there, 4 here.; set these fields of model.autoencoder",
        ),
        # of another size
        (
            world_model,
            GENIE,
            to_dict(with_values(GENIE, {"model.width": 64})),
            "holds another network .width is 64 there, 32 here",
        ),
        (
            world_model,
            IVIDEOGPT,
            to_dict(with_values(IVIDEOGPT, {"model.blocks": 3})),
            "holds another network .blocks is 3 there, 2 here.; set these fields of model alike",
        ),
        (
            world_model,
            IVIDEOGPT,
            to_dict(with_values(IVIDEOGPT, {"model.autoencoder.codes": 64})),
            "knows 64 codes, this tokenizer has 32; set model.autoencoder.codes",
        ),
        (
            tokenizer,
            IVIDEOGPT,
            to_dict(with_values(IVIDEOGPT, {"model.autoencoder.latent": 4})),
            "holds another network .latent is 4 there, 8 here.; set these fields of model.autoencoder alike",
        ),
        (
            world_model,
            IRASIM,
            to_dict(with_values(IRASIM, {"model.width": 32})),
            "holds another network .width is 32 there, 16 here.; set these fields of model alike",
        ),
        (
            world_model,
            IRASIM,
            to_dict(with_values(IRASIM, {"model.integrate_actions": False})),
            "integrate_actions is False there, True here",
        ),
    ],
)
def test_weights_of_something_else_are_refused(
    read: Callable[[Config, Path], Any], config: Config, settings: Any, line: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=line) as error:
        read(config, saved(tmp_path, settings))
    assert "\n" not in str(error.value) and str(tmp_path) in str(error.value)


@pytest.mark.parametrize("config", [GENIE, IVIDEOGPT, IRASIM, COGVIDEOX, SDXL], ids=[*families.FAMILIES, "sdxl"])
@pytest.mark.parametrize("read", [world_model, tokenizer])
def test_a_path_without_weights_is_named(read: Callable[[Config, Path], Any], config: Config, tmp_path: Path) -> None:
    """A directory of something else, and a public file in place of what the converter makes of it."""
    (tmp_path / "file.safetensors").write_bytes(b"")
    for path in (tmp_path, tmp_path / "nowhere", tmp_path / "file.safetensors"):
        with pytest.raises(UserError, match=str(path)) as error:
            read(config, path)
        assert "\n" not in str(error.value)


def test_frozen_weights_need_a_path() -> None:
    with pytest.raises(ConfigError, match=r"tokenizer_train.steps is 0; it must be 1 … 2147483647"):
        with_values(SDXL, {"tokenizer_train.start_from": ""})


@pytest.mark.parametrize(
    ("config", "size", "line"),
    [
        (
            presets.get("genie_35m_actions"),
            250,
            r"downsampling 16 of the tokenizer .* clips of 240 or 256 pixels",
        ),
        (
            presets.get("ivideogpt_64"),
            72,
            r"72 pixels a side, which 16 does not divide .*; take clips of 64 pixels,",
        ),
        (presets.get("irasim_xl"), 250, r"250 pixels .* 16 pixels of a token .* take clips of 240 or 256 pixels"),
        (presets.get("irasim_tiny"), 60, r"60 pixels .* 8 pixels of a token .* take clips of 56 or 64 pixels"),
    ],
    ids=["genie", "ivideogpt", "irasim", "irasim_tiny"],
)
def test_images_that_do_not_divide_into_tokens_are_refused(config: Config, size: int, line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        replace(config, sim=replace(config.sim, image_size=size))
