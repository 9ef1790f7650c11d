"""Which departures from the paper each preset makes."""

from dataclasses import asdict
from typing import Any

import pytest

from rsjax.config import CorruptionConfig, Departures, SampleConfig, TokenModelConfig, presets

SIZES = ("s", "m", "l")
ROBOSCAPE = tuple(f"roboscape_{size}" for size in SIZES)
PHYSICS = tuple(f"roboscape_physics_{size}" for size in SIZES)
FULL_SIZE = (*ROBOSCAPE, *PHYSICS, "genie_35m", "genie_138m", "genie_35m_actions")
KEYPOINTS = {"observed_anchor": True, "visible_keypoints": True}
TINY = KEYPOINTS | {
    "integrate_actions": True,
    "read_previous": True,
    "whole_frames": True,
    "more_norms": True,
    "embedding_std": 0.5,
    "shifts": 3,
    "self_conditioning": 0.5,
    "self_conditioning_after": 500,
    "mean_codes": True,
    "read_means": True,
}


def active(model: Any) -> dict[str, Any]:
    """The departures of a model that are on, those of sampling included."""
    assert isinstance(model, TokenModelConfig)
    off_sampling = {"mean_codes": False, "read_means": False, "guidance": 1.0, "keep_still": None}
    off = asdict(Departures()) | off_sampling
    sampling = {name: getattr(model.sample, name) for name in off_sampling}
    values = asdict(model.departures) | sampling
    return {name: value for name, value in values.items() if value != off[name]}


@pytest.mark.parametrize("name", FULL_SIZE)
def test_a_full_size_preset_has_no_departure(name: str) -> None:
    model = presets.get(name).model
    assert isinstance(model, TokenModelConfig)
    assert model.departures == Departures()
    assert model.corruption == CorruptionConfig()
    assert model.sample == SampleConfig(cache_dtype="bfloat16")
    assert active(model) == {}


SMALL = {
    "debug": KEYPOINTS,
    "tiny": TINY,
    "tiny_policies": {name: value for name, value in TINY.items() if name != "self_conditioning_after"},
    "roboscape_tiny": TINY,
    "multitask": TINY,
    "roboscape_multitask": TINY,
}


@pytest.mark.parametrize(("name", "departures"), SMALL.items())
def test_a_small_preset_has_exactly_these_departures(name: str, departures: dict[str, Any]) -> None:
    assert active(presets.get(name).model) == departures


def test_every_departure_is_off_by_default() -> None:
    assert not any(asdict(Departures()).values())
