"""Families of models: moving a run to another one, and reading one back from a file."""

import json
from dataclasses import replace
from typing import Any

import pytest

from rsjax.config import (
    Config,
    ConfigError,
    CorruptionConfig,
    DepthBranch,
    DepthHead,
    GenieConfig,
    LossConfig,
    ModelConfig,
    NoDepth,
    PublicCodeConfig,
    RoboScapeConfig,
    SampleConfig,
    families,
    from_dict,
    presets,
    register_family,
    to_dict,
)

DEBUG = presets.debug()
CHANGED = (
    RoboScapeConfig(width=32, depth=NoDepth(), loss=LossConfig(gamma=2.0), corruption=None, max_frames=9),
    RoboScapeConfig(corruption=CorruptionConfig(probability=0.1), public_code=PublicCodeConfig(qk_norm=True)),
    GenieConfig(action_encoder="none", heads=2, sample=SampleConfig(steps=3, cache_dtype="bfloat16")),
)


def as_read(values: dict[str, Any]) -> Config:
    """A configuration out of the JSON of a file."""
    return from_dict(Config, json.loads(json.dumps(values)))


@pytest.mark.parametrize("model", [*CHANGED, *(kind() for kind in families().values())], ids=lambda model: model.family)
def test_every_family_survives_json(model: ModelConfig) -> None:
    config = replace(DEBUG, model=model)
    values = to_dict(config)
    assert values["model"]["family"] == model.family
    assert as_read(values) == config
    assert type(as_read(values).model) is type(model)
    assert hash(as_read(values)) == hash(config)


def test_a_family_keeps_changed_fields_and_its_own_defaults_for_the_others() -> None:
    corruption, sample = CorruptionConfig(random_token_rate=0.1), SampleConfig(steps=5)
    shared: dict[str, Any] = {"width": 64, "heads": 4, "corruption": corruption, "sample": sample}
    config = replace(DEBUG, model=RoboScapeConfig(depth=DepthHead(), **shared))
    genie = config.with_family("genie")
    assert genie == replace(config, model=GenieConfig(**shared)) == genie.with_family("genie")
    # The action encoder is at RoboScape's default, so it becomes Genie's; set on purpose, it is kept.
    assert (RoboScapeConfig().action_encoder, GenieConfig().action_encoder) == ("linear", "mlp")
    assert genie.with_family("roboscape") == replace(config, model=replace(config.model, depth=DepthBranch()))  # type: ignore[call-arg]
    without = replace(config, model=GenieConfig(width=64, heads=4, action_encoder="none"))
    assert without.with_family("roboscape").model == RoboScapeConfig(width=64, heads=4, action_encoder="none")


@pytest.mark.parametrize("preset", ["tiny", "irasim_tiny", "cogvideox_tiny", "ivideogpt_tiny"])
@pytest.mark.parametrize("name", ["roboscape", "genie", "ivideogpt", "irasim", "cogvideox"])
def test_fields_of_one_name_and_unlike_types_stay_with_their_family(preset: str, name: str) -> None:
    """They all have ``sample``, and some ``autoencoder`` and ``positions``, each in its own way."""
    config = presets.get(preset).with_family(name)
    assert as_read(to_dict(config)) == config
    width, dtype = (getattr(config.model, field) for field in ("width", "compute_dtype"))
    before: Any = presets.get(preset).model
    assert (width, dtype) == (before.width, before.compute_dtype)


def test_an_unknown_family_is_refused_with_the_nearest_and_all() -> None:
    expected = r"unknown model 'geni'; did you mean 'genie'\? \(models: cogvideox, genie, irasim"
    values = to_dict(DEBUG)
    values["model"]["family"] = "geni"
    with pytest.raises(ConfigError, match=expected):
        as_read(values)
    with pytest.raises(ConfigError, match=expected):
        DEBUG.with_family("geni")


def test_two_families_of_one_name_are_refused() -> None:
    with pytest.raises(ConfigError, match="two families of models are named 'genie'"):

        @register_family("genie")
        class Another(ModelConfig):
            pass

    assert families()["genie"] is GenieConfig


@pytest.mark.parametrize("name", ["random_token_rate", "probability"])
def test_rates_of_corruption_are_shares_not_percentages(name: str) -> None:
    with pytest.raises(ConfigError, match=rf"model.corruption.{name} is 20; it must be 0 … 1"):
        CorruptionConfig(**{name: 20})
