"""Configurations: what cannot run is refused, and content keys follow results and nothing else."""

import dataclasses
import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax import config as c
from rsjax.config import presets

# Its own, so that tuning the presets does not touch these tests.
BASE = c.Config(
    name="base",
    sim=c.SimConfig(episodes=8, test_episodes=2, frames=6, tracks=64),
    tokenizer=c.TokenizerConfig(
        image_size=64, patch_size=4, channels=16, channel_multipliers=(1, 2), norm_groups=8, code_bits=8
    ),
    model=c.ModelConfig(frames=6, grid=8, code_bits=8, width=32, blocks=2, heads=2),
)


def leaves(part: Any, prefix: str = "") -> list[tuple[str, bool]]:
    """(dotted path, whether it is a runtime field) of every plain field within ``part``."""
    found: list[tuple[str, bool]] = []
    for field in dataclasses.fields(part):
        value, path = getattr(part, field.name), prefix + field.name
        if dataclasses.is_dataclass(value):
            found += leaves(value, f"{path}.")
        else:
            found.append((path, bool(field.metadata.get("runtime"))))
    return found


def other(value: Any) -> Any:
    """A value of the same type that differs."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        return value + 1
    return (*value, 1) if isinstance(value, tuple) else value + "x"


def altered(part: Any, path: str) -> Any:
    """A copy of ``part`` in which the field at ``path`` differs, past the checks: it need not make sense."""
    head, _, rest = path.partition(".")
    copy = object.__new__(type(part))
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if field.name == head:
            value = altered(value, rest) if rest else other(value)
        object.__setattr__(copy, field.name, value)
    return copy


@pytest.mark.parametrize(("path", "runtime"), leaves(BASE))
def test_the_key_changes_exactly_with_fields_that_change_results(path: str, runtime: bool) -> None:
    changed = altered(BASE, path)
    assert changed != BASE
    assert (c.content_key(changed) == c.content_key(BASE)) == runtime


def test_the_key_tells_parts_and_their_order_apart() -> None:
    keys = [c.content_key(*parts) for parts in ((), (1,), ("1",), (1, 2), (2, 1), (c.MaskConfig(),), (c.EvalConfig(),))]
    assert len(set(keys)) == len(keys)
    assert all(len(key) == 16 and int(key, 16) >= 0 for key in keys)


@pytest.mark.parametrize("name", sorted(presets.PRESETS))
def test_presets_are_hashable_and_survive_json(name: str) -> None:
    config = presets.get(name)
    assert config.name == name
    assert hash(config) == hash(dataclasses.replace(config))
    assert c.from_dict(c.Config, json.loads(json.dumps(c.to_dict(config)))) == config


def test_a_stored_configuration_with_an_unknown_field_is_refused_by_name() -> None:
    plain = c.to_dict(BASE)
    plain["train"]["optimizer"]["momentum"] = 0.9
    with pytest.raises(c.ConfigError, match="OptimizerConfig has no field momentum"):
        c.from_dict(c.Config, plain)


def test_a_stored_configuration_is_fields_by_name_and_may_lack_some() -> None:
    plain = c.to_dict(BASE)
    del plain["train"]["seed"]
    assert c.from_dict(c.Config, plain) == BASE
    for damaged in ([], [["width", 3]], 3):
        with pytest.raises(c.ConfigError, match="ModelConfig is to be fields by name"):
            c.from_dict(c.Config, plain | {"model": damaged})


@pytest.mark.parametrize(
    ("section", "changes", "names"),
    [
        ("sim", {"frames": 1}, "sim.frames is 1"),
        ("sim", {"test_episodes": 8}, "sim.test_episodes is 8"),
        ("sim", {"test_episodes": 0}, "sim.test_episodes is 0"),
        ("sim", {"control_steps": 0}, "sim.control_steps is 0"),
        ("sim", {"frames": 7}, "model.frames holds positions for 6"),
        ("sim", {"image_size": 128}, "sim.image_size is 128 but tokenizer.image_size is 64"),
        ("sim", {"control_steps": 2}, "is 14 but model.action_dim is 28"),
        ("tokenizer", {"image_size": 65}, "not divisible by the downsampling 8"),
        ("tokenizer", {"code_bits": 9}, "tokenizer.code_bits 9 does not divide into 2"),
        ("tokenizer", {"norm_groups": 5}, "tokenizer.norm_groups 5"),
        ("tokenizer", {"image_size": 8, "adaptive_norm": True}, "needs a grid of more than one cell"),
        ("tokenizer_train", {"adversarial": -0.1}, "tokenizer_train.adversarial is -0.1"),
        ("tokenizer", {"patch_size": 8}, "tokenizer grid is 4 but model.grid is 8"),
        ("tokenizer", {"code_bits": 10}, "tokenizer.code_bits is 10 but model.code_bits is 8"),
        ("model", {"heads": 3}, "model.width 32 is not divisible by model.heads 3"),
        ("model", {"action_dim": -1}, "model.action_dim is -1"),
        ("model", {"action_dim": 0, "integrate_actions": True}, "model.action_dim is 0"),
        ("model", {"action_dim": 0, "action_dropout": 0.1}, "model.action_dim is 0"),
        ("model", {"action_dropout": 1.0}, "model.action_dropout is 1.0"),
        ("model", {"vocabularies": 1}, "tokenizer.vocabularies is 2 but model.vocabularies is 1"),
        ("mask", {"prompt_frames": 0}, "mask.prompt_frames is 0"),
        ("mask", {"prompt_frames": 6}, "mask.prompt_frames is 6 of 6 frames"),
        ("loss", {"num_keypoints": 65}, "loss.num_keypoints is 65"),
        ("eval", {"clips": 1}, "eval.clips is 1 of sim.test_episodes 2"),
        ("eval", {"batch_size": 0}, "eval.batch_size is 0"),
        ("sample", {"steps": 0}, "sample.steps is 0"),
        ("sample", {"temperature": -0.5}, "sample.temperature is -0.5"),
    ],
)
def test_what_cannot_run_is_refused_by_name(section: str, changes: dict[str, Any], names: str) -> None:
    with pytest.raises(c.ConfigError) as caught:
        dataclasses.replace(BASE, **{section: dataclasses.replace(getattr(BASE, section), **changes)})
    assert names in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_model_without_actions_fits_any_data() -> None:
    model = dataclasses.replace(BASE.model, action_dim=0)
    assert dataclasses.replace(BASE, model=model).model.action_dim == 0


def test_more_keypoints_than_tracks_are_fine_when_keypoints_are_off() -> None:
    loss = dataclasses.replace(BASE.loss, num_keypoints=10_000, keypoints=False)
    assert dataclasses.replace(BASE, loss=loss).loss.terms(depth_branch=True) == {"rgb": 1.0, "depth": 1.0}


def test_both_training_loops_are_set_alike_and_nothing_else_changes() -> None:
    before = presets.debug()
    after = before.with_loops(profile=3, wandb="robots")
    assert (after.train.profile, after.tokenizer_train.wandb) == (3, "robots")
    assert after.with_loops(profile=0, wandb="") == before


def test_the_paper_s_loss_weights() -> None:
    loss = c.LossConfig()
    assert loss.terms(depth_branch=True) == {"rgb": 1.0, "depth": 1.0, "keypoint": 0.01, "attention": 1.0}
    assert loss.terms(depth_branch=False) == {"rgb": 1.0, "keypoint": 0.01, "attention": 1.0}
    assert loss.gamma == 5.0


@given(patch=st.sampled_from([1, 2, 4]), levels=st.integers(1, 4), cells=st.integers(1, 8))
def test_the_grid_is_what_halving_level_by_level_leaves(patch: int, levels: int, cells: int) -> None:
    size = cells * patch
    for _ in range(levels - 1):
        size *= 2
    tokenizer = c.TokenizerConfig(image_size=size, patch_size=patch, channel_multipliers=(1,) * levels)
    assert tokenizer.grid == cells
    assert tokenizer.grid * tokenizer.downsampling == size
