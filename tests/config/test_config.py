"""Configurations: what cannot run is refused, and content keys follow results and nothing else."""

import dataclasses
import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax import config as c
from rsjax.config import presets
from rsjax.config.config_fields import with_values
from rsjax.models.roboscape.architecture import Architecture

# Its own, so that tuning the presets does not touch these tests.
BASE = c.Config(
    name="base",
    sim=c.SimConfig(episodes=8, test_episodes=2, frames=6, tracks=64),
    tokenizer=c.TokenizerConfig(patch_size=4, channels=16, channel_multipliers=(1, 2), norm_groups=8, code_bits=8),
    model=c.RoboScapeConfig(width=32, blocks=2, heads=2),
)


WHOLE = {"read_previous": True, "whole_frames": True}


def keyed(part: Any, prefix: str = "", in_key: bool = True) -> list[tuple[str, bool]]:
    """(dotted path, whether the content key covers it) of every plain field within ``part``."""
    paths: list[tuple[str, bool]] = []
    for field in dataclasses.fields(part):
        value, path = getattr(part, field.name), prefix + field.name
        covered = in_key and not field.metadata.keys() & {"runtime", "sampling"}
        paths += keyed(value, f"{path}.", covered) if dataclasses.is_dataclass(value) else [(path, covered)]
    return paths


def other(value: Any) -> Any:
    """A value of the same type that differs."""
    if value is None:
        return "x"
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


def settings_key(config: c.Config) -> str:
    """The part of the evaluation's key that covers how the model is sampled."""
    return c.content_key(*c.sampling_settings(config.model))


@pytest.mark.parametrize(("path", "in_key"), keyed(BASE))
def test_the_key_changes_exactly_with_fields_that_change_results(path: str, in_key: bool) -> None:
    """Fields of sampling change what is generated, not what is trained: they have a key of their own."""
    changed = altered(BASE, path)
    assert changed != BASE
    assert (c.content_key(changed) != c.content_key(BASE)) == in_key
    assert (settings_key(changed) != settings_key(BASE)) == path.startswith("model.sample.")


def test_the_key_covers_the_family() -> None:
    keys = {c.content_key(config) for config in (c.TokenModelConfig(), c.RoboScapeConfig(), c.GenieConfig())}
    assert len(keys) == 3


def test_the_key_tells_parts_and_their_order_apart() -> None:
    keys = [
        c.content_key(*parts)
        for parts in ((), (1,), ("1",), (1, 2), (2, 1), (c.CorruptionConfig(),), (c.EvalConfig(),))
    ]
    assert len(set(keys)) == len(keys)
    assert all(len(key) == 16 and int(key, 16) >= 0 for key in keys)


@pytest.mark.parametrize("name", sorted(presets.PRESETS))
def test_presets_are_hashable_and_survive_json(name: str) -> None:
    config = presets.get(name)
    assert config.name == name
    assert hash(config) == hash(dataclasses.replace(config))
    assert c.from_dict(c.Config, json.loads(json.dumps(c.to_dict(config)))) == config


def test_shares_of_a_recipe_sum_to_one() -> None:
    mixed = c.SimConfig(recipe=("expert=2.5", "recorded:runs/a=b/episodes=0.5", "grasps"))
    assert mixed.shares == {"expert": 0.625, "recorded:runs/a=b/episodes": 0.125, "grasps": 0.25}


def test_clips_of_another_store_and_those_that_begin_midway_may_begin_anywhere() -> None:
    assert BASE.one_start
    mixed = c.CurriculumStageConfig((c.ComponentConfig(), c.ComponentConfig(store="other-clips")))
    assert not with_values(BASE, {"train.curriculum": (mixed,)}).one_start
    assert not with_values(BASE, {"sim.recipe": ("expert", "midway")}).one_start
    assert not with_values(BASE, {"model.backwards": "on"}).one_start
    assert not Architecture.create(with_values(BASE, {"train.curriculum": (mixed,)})).one_start


def test_a_stored_configuration_may_lack_fields() -> None:
    plain = c.to_dict(BASE)
    del plain["train"]["seed"]
    assert c.from_dict(c.Config, plain) == BASE


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("train.seed", "3", "TrainConfig.seed must be a whole number; it is '3'"),
        ("train.steps", True, "TrainConfig.steps must be a whole number; it is True"),
        ("train.steps", 2.0, "TrainConfig.steps must be a whole number; it is 2.0"),
        ("train.steps", None, "TrainConfig.steps must be a whole number; it is None"),
        ("tokenizer_train.flip", 1, "TokenizerTrainConfig.flip must be true or false; it is 1"),
        ("train.ema", "0.9", "TrainConfig.ema must be a number; it is '0.9'"),
        ("runtime.sharding", "ring", "RuntimeConfig.sharding must be one of auto, jit, pmap, mesh; it is 'ring'"),
        (
            "tokenizer.channel_multipliers",
            [1, "2"],
            "TokenizerConfig.channel_multipliers must be a whole number; it is '2'",
        ),
        ("sim.camera", ["front"], r"SimConfig.camera must be text; it is \['front'\]"),
        ("name", {}, "Config.name must be text; it is {}"),
        ("model.family", 3, "model has no family"),
        ("model", [["width", 3]], "ModelConfig must be fields by name"),
        ("model", 3, "ModelConfig must be fields by name"),
        ("train.optimizer.momentum", 0.9, "AdamW has no field momentum"),
    ],
)
def test_a_stored_field_that_does_not_fit_is_refused_by_name(path: str, value: Any, message: str) -> None:
    plain = c.to_dict(BASE)
    *heads, name = path.split(".")
    part = plain
    for head in heads:
        part = part[head]
    part[name] = value
    with pytest.raises(c.ConfigError, match=message):
        c.from_dict(c.Config, plain)


@pytest.mark.parametrize(
    ("path", "changes", "names"),
    [
        ("", {"prompt_frames": 0}, "prompt_frames is 0 of 6 frames"),
        ("", {"prompt_frames": 6}, "prompt_frames is 6 of 6 frames"),
        ("train", {"seed": -1}, "train.seed is -1; a seed is a whole number from 0 to 4294967295"),
        ("tokenizer_train", {"seed": 2**32}, "tokenizer_train.seed is 4294967296; a seed"),
        ("train.optimizer", {"learning_rate": math.inf}, "train.optimizer.learning_rate is inf; it must be a finite"),
        ("train.optimizer", {"learning_rate": -1e-3}, "optimizer.learning_rate is -0.001; it must be at least 0"),
        ("train.optimizer", {"betas": (0.9, 1.5)}, "optimizer.betas are (0.9, 1.5); they are two numbers"),
        ("model.loss", {"depth_weight": math.nan}, "model.loss.depth_weight is nan; it must be at least 0"),
        ("model.corruption", {"probability": -math.inf}, "model.corruption.probability is -inf; it must be 0 … 1"),
        ("train", {"ema": math.nan}, "train.ema is nan; it must be 0 … 1"),
        ("runtime", {"max_damaged": 2.0}, "runtime.max_damaged is 2.0; it must be 0 … 1"),
        ("runtime", {"log_every": 2**63}, "runtime.log_every is 9223372036854775808; it must fit in 64 bits"),
        ("", {"train": c.TrainConfig(curriculum=(c.CurriculumStageConfig(epochs=math.inf),))}, "epochs is inf"),
        ("tokenizer", {"vocabularies": 0}, "tokenizer.vocabularies is 0; it must be at least 1"),
        ("tokenizer", {"channel_multipliers": ()}, "tokenizer.channel_multipliers are ()"),
        ("sim", {"frames": 1}, "sim.frames is 1"),
        ("sim", {"test_episodes": 8}, "sim.test_episodes is 8"),
        ("sim", {"test_episodes": 0}, "sim.test_episodes is 0"),
        ("sim", {"control_steps": 0}, "sim.control_steps is 0"),
        ("sim", {"image_size": 65}, "images have 65 pixels a side, which the downsampling 8"),
        ("tokenizer", {"code_bits": 9}, "tokenizer.code_bits 9 does not divide into 2"),
        ("tokenizer", {"norm_groups": 5}, "tokenizer.norm_groups 5"),
        ("tokenizer", {"patch_size": 32, "adaptive_norm": True}, "needs a grid of more than one cell"),
        ("tokenizer_train.adversarial", {"weight": -0.1}, "tokenizer_train.adversarial.weight is -0.1"),
        ("model", {"max_frames": 5}, "clips have 6 frames but model.max_frames is 5"),
        ("model", {"heads": 3}, "model.width 32 is not divisible by model.heads 3"),
        ("model", {"heads": 32, "departures.rotary": True}, "a head has 1 (model.width / model.heads)"),
        ("model", {"action_encoder": "none", "departures.integrate_actions": True}, "model.action_encoder is none"),
        ("model", {"action_encoder": "none", "departures.action_dropout": 0.1}, "model.action_encoder is none"),
        ("model", {"action_encoder": "norms", "public_code.qk_norm": True}, "qk_norm leaves the blocks without norms"),
        ("model.departures", {"whole_frames": True}, "read_previous is off"),
        ("model.departures", WHOLE | {"visible_prefix": 0.5}, "model.departures.visible_prefix is 0.5"),
        ("model.departures", {"self_conditioning": 0.5}, "self_conditioning is 0.5, but without whole_frames"),
        ("model.departures", WHOLE | {"self_conditioning": 1.5}, "self_conditioning is 1.5; it must be 0 … 1"),
        ("model.departures", WHOLE | {"self_conditioning_after": -1}, "self_conditioning_after is -1; it must be at"),
        ("model.departures", {"action_dropout": 1.0}, "model.departures.action_dropout is 1.0"),
        ("model.loss", {"num_keypoints": 0}, "model.loss.num_keypoints is 0"),
        ("model.sample", {"steps": 0}, "model.sample.steps is 0"),
        ("model.sample", {"temperature": -0.5}, "model.sample.temperature is -0.5"),
        ("model.sample", {"guidance": 2.0}, "model.sample.guidance is 2.0"),
        ("model.sample", {"window_stride": 6}, "model.sample.window_stride is 6 of 6 positions"),
        ("eval", {"clips": 1}, "eval.clips is 1 of sim.test_episodes 2"),
        ("eval", {"batch_size": 0}, "eval.batch_size is 0"),
        ("sim", {"env": "rope", "tasks": ("string",)}, "sim.tasks names 'string', no task of rope"),
        ("sim", {"recipe": ()}, "sim.recipe is empty; name at least one of expert, grasps"),
        ("sim", {"recipe": ("grasp=0.5",)}, "sim.recipe names 'grasp'; did you mean 'grasps'?"),
        ("sim", {"recipe": ("grasps=some",)}, "sim.recipe has 'grasps=some'; a share must be a number above 0"),
        ("sim", {"recipe": ("grasps=0",)}, "sim.recipe has 'grasps=0'; a share must be a number above 0"),
        ("sim", {"recipe": ("grasps", "grasps=2")}, "sim.recipe is grasps grasps=2; name each recipe once"),
        (
            "sim",
            {"env": "metaworld", "camera": "near", "recipe": ("grasps",)},
            "sim.env is metaworld, which has expert",
        ),
        ("sim", {"tasks": ("reach-v3",)}, "sim.tasks names 'reach-v3', but sim.env is lift"),
        ("sim", {"env": "metaworld", "camera": "near", "tasks": ("raech",)}, "no task of Meta-World; did you mean"),
        ("sim", {"env": "metaworld"}, "sim.camera is 'agentview', which Meta-World does not have"),
        (
            "sim",
            {"env": "metaworld", "camera": "near", "tasks": ("reach",), "unseen_tasks": ("reach",)},
            "sim.unseen_tasks has reach, which sim.tasks trains on",
        ),
        ("model", {"blocks": 0}, "model.blocks is 0; it must be at least 1"),
        ("tokenizer_train", {"frames_per_clip": 0}, "tokenizer_train.frames_per_clip is 0"),
        ("tokenizer_train", {"depth_share": 1.5}, "tokenizer_train.depth_share is 1.5"),
        ("tokenizer_train", {"entropy_group": 3}, "tokenizer_train.entropy_group is 3; it must divide the 32 images"),
        ("train.optimizer", {"drop_at": (1.0,)}, "optimizer.drop_at is (1.0,)"),
        ("train.optimizer", {"final_share": 2.0}, "optimizer.final_share is 2.0"),
        ("train", {"batch_size": 0}, "train.batch_size is 0"),
        ("train", {"batch_size": 2, "accumulate": 3}, "batch_size 2 does not divide into accumulate = 3 parts"),
        ("runtime", {"checkpoint_every": 0}, "runtime.checkpoint_every is 0"),
        ("runtime", {"eval_every": -1}, "runtime.eval_every is -1"),
        ("runtime", {"fsdp": 2}, "runtime.fsdp is 2, which needs runtime.sharding mesh; it is auto"),
    ],
)
def test_what_cannot_run_is_refused_by_name(path: str, changes: dict[str, Any], names: str) -> None:
    with pytest.raises(c.ConfigError) as caught:
        with_values(BASE, {f"{path}.{field}".lstrip("."): value for field, value in changes.items()})
    assert names in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"keep_last": 0}, "keep_last is 0"),
        ({"keep_every": -1}, "keep_every is -1"),
        ({"skip_budget": -1}, "skip_budget is -1"),
        ({"steps": 20, "restarts": (50,)}, "they lie before its end, steps = 20"),
        ({"steps": 20, "restarts": (10, 5)}, "they are steps above 0, in their order"),
        ({"early_stop": c.EarlyStopConfig(), "keep_best": False}, "early_stop is on but keep_best is off"),
    ],
)
def test_what_a_loop_cannot_do_is_refused_by_name(changes: dict[str, Any], line: str) -> None:
    with pytest.raises(c.ConfigError) as caught:
        c.LoopConfig(**changes)
    assert line in str(caught.value)


def test_the_network_fits_clips_and_tokenizer_by_itself() -> None:
    """Positions, grid, codes and the actions' width are derived, so no setting can contradict them."""
    changes = {"sim.frames": 9, "sim.image_size": 128, "sim.control_steps": 2, "tokenizer.code_bits": 10}
    config = with_values(BASE, changes | {"tokenizer.vocabularies": 5, "model.departures.integrate_actions": True})
    network = Architecture.create(config)
    assert (network.frames, network.grid, network.action_inputs) == (9, config.grid, 2 * 14)
    assert config.grid == config.tokenizer.grid(128) == 16
    assert (network.code_bits, network.vocabularies, network.vocabulary_size) == (10, 5, 4)
    assert Architecture.create(with_values(config, {"model.max_frames": 12})).frames == 12
    without_actions = with_values(BASE, {"model.action_encoder": "none", "sim.control_steps": 2})
    assert Architecture.create(without_actions).action_inputs == 0


def test_more_keypoints_than_tracks_are_fine() -> None:
    config = with_values(BASE, {"model.loss.num_keypoints": 10_000, "model.loss.keypoints": "none"})
    assert isinstance(config.model, c.RoboScapeConfig)
    assert config.model.loss_weights == {"rgb": 1.0, "depth": 1.0}
    assert with_values(BASE, {"model.loss.num_keypoints": 65}).clips.tracks == 64


def test_a_loop_has_its_own_settings_and_those_that_both_share() -> None:
    config = with_values(presets.debug(), {"runtime.profile": 3, "train.seed": 5, "tokenizer_train.steps": 7})
    loops = [config.loop(stage) for stage in ("tokenizer", "world_model")]
    assert [(loop.steps, loop.seed, loop.profile) for loop in loops] == [(7, 0, 3), (4, 5, 3)]


def test_the_paper_s_loss_weights() -> None:
    model = c.RoboScapeConfig()
    assert model.loss_weights == {"rgb": 1.0, "depth": 1.0, "keypoint": 0.01, "attention": 1.0}
    assert c.RoboScapeConfig(depth=c.NoDepth()).loss_weights == {"rgb": 1.0, "keypoint": 0.01, "attention": 1.0}
    assert model.loss.gamma == 5.0
    assert c.GenieConfig().loss_weights == {"rgb": 1.0}
    for off in ("depth", "keypoint", "attention"):
        without: dict[str, Any] = {f"{off}_weight": 0.0}
        expected = {name: weight for name, weight in model.loss_weights.items() if name != off}
        assert c.RoboScapeConfig(loss=c.LossConfig(**without)).loss_weights == expected, "0 switches a term off"


@given(patch=st.sampled_from([1, 2, 4]), levels=st.integers(1, 4), cells=st.integers(1, 8))
def test_the_grid_is_what_halving_level_by_level_leaves(patch: int, levels: int, cells: int) -> None:
    size = cells * patch
    for _ in range(levels - 1):
        size *= 2
    tokenizer = c.TokenizerConfig(patch_size=patch, channel_multipliers=(1,) * levels)
    assert tokenizer.grid(size) == cells
    assert cells * tokenizer.downsampling == size
