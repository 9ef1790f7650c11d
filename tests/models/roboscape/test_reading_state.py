"""Frames, and what the state heads read from them, are the same however a video is generated."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import KeepStillConfig, SampleConfig, StateHeadsConfig
from rsjax.data.store import Store, encode_clip, open_store, write_store
from rsjax.models.base import create_model
from rsjax.models.branch_states import Decoding
from rsjax.models.roboscape.imagine import GROUP
from rsjax.models.roboscape.teacher_forcing import score_tokens
from rsjax.models.trained import TrainedModel
from tests.tools.pipeline import toy

FRAMES = 9  # the window is 6


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return toy.store(tmp_path_factory.mktemp("state") / "clips")


@pytest.fixture(scope="module")
def model(clips: Store) -> TrainedModel:
    sample = SampleConfig(steps=2, keep_still=KeepStillConfig(noise=25.0, blur=0.2))
    return toy.trained(clips, toy.with_model(toy.config(), sample=sample, state_heads=StateHeadsConfig()))


@pytest.fixture(scope="module")
def actions(model: TrainedModel) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (FRAMES, model.config.clips.action_dim)).astype(np.float32)


@pytest.fixture(scope="module")
def generated(model: TrainedModel, clips: Store, actions: np.ndarray) -> Any:
    clip = clips.source("test")[1]
    return model.generate(clip["rgb"][:1], actions, clip["depth"][:1])


def test_a_video_has_the_state_of_every_frame(generated: Any) -> None:
    assert generated.state is not None
    assert generated.state.shape == (FRAMES, 3)
    assert np.ptp(generated.state, axis=0).min() > 0
    assert np.all((generated.state[:, 0] > 0) & (generated.state[:, 0] < 1))


def test_plans_steps_and_branches_show_and_read_what_generate_does(
    model: TrainedModel, clips: Store, actions: np.ndarray, generated: Any
) -> None:
    clip = clips.source("test")[1]
    first = Video(clip["rgb"][None, :1], clip["depth"][None, :1])
    planned: Any = model.model.plan(model.params, model.assets, first, actions[None].repeat(2, 0), last=2)
    np.testing.assert_array_equal(planned.rgb[1], generated.rgb[-2:])
    np.testing.assert_allclose(planned.state[1], generated.state, atol=1e-4)

    stepping = model.model.imagine(model.params, model.assets, 1)
    frames = [stepping.restart(np.array([True]), first, np.array([0]))]
    frames += [stepping.step(row[None]) for row in actions[1:]]
    lanes = model.model.branching(model.params, model.assets, True)
    state = lanes.begin(first)
    np.testing.assert_array_equal(state.rgb, clip["rgb"][0])
    branched = [state]
    for row in actions[1:]:
        [state] = lanes.advance([state], row[None], [Decoding(steps=2)])
        branched.append(state)
    rgb: list[Any] = [[frame.rgb[0, 0] for frame in frames], [each.rgb for each in branched]]
    read: list[Any] = [[frame.state[0, 0] for frame in frames], [each.state for each in branched]]  # type: ignore[index]
    for shown, readings in zip(rgb, read, strict=True):
        assert np.abs(np.stack(shown).astype(int) - generated.rgb).max() <= 1  # decoded in other numbers
        np.testing.assert_allclose(np.stack(readings), generated.state, atol=1e-4)


def test_clips_of_several_groups_are_those_that_run_alone(
    model: TrainedModel, clips: Store, actions: np.ndarray
) -> None:
    """Also when one of the second group begins again while the others go on."""
    source = clips.source("test")
    firsts = Video(*(np.stack([source[number][name][:1] for number in (0, 1)]) for name in ("rgb", "depth")))
    count = GROUP + 2
    together = model.model.imagine(model.params, model.assets, count)
    rows = actions[1:, None].repeat(count, axis=1)
    begun = together.restart(np.ones(count, bool), firsts[np.arange(count) % 2], np.arange(count))
    made = [begun, together.step(rows[0]), together.step(rows[1])]
    again = [together.restart(np.arange(count) == GROUP, firsts[1:], np.array([3])), together.step(rows[0])]
    for index, numbers in ((GROUP + 1, [GROUP + 1]), (3, [3, GROUP])):
        alone = model.model.imagine(model.params, model.assets, 1)
        wanted: list[Any] = [alone.restart(np.array([True]), firsts[1:], np.array([index])), alone.step(rows[0, :1])]
        wanted.append(alone.step(rows[1, :1]))
        for number in numbers:
            shown: list[Any] = made
            place = number
            if number == GROUP:
                shown = [again[0][np.zeros(count, int)], again[1]]
            for frame, expected in zip(shown, wanted, strict=False):
                np.testing.assert_allclose(frame.rgb[place].astype(int), expected.rgb[0].astype(int), atol=1)
                np.testing.assert_allclose(frame.state[place], expected.state[0], atol=1e-4)
                np.testing.assert_allclose(frame.depth[place], expected.depth[0], atol=1e-3)


def test_a_branch_has_the_features_that_teacher_forcing_on_its_frames_has(
    model: TrainedModel, clips: Store, actions: np.ndarray
) -> None:
    family: Any = model.model
    arch = family.architecture
    clip = clips.source("test")[0]
    lanes = model.model.branching(model.params, model.assets, True)
    state = lanes.begin(Video(clip["rgb"][None, :1], clip["depth"][None, :1]))
    states = [state]
    for row in actions[1:]:
        [state] = lanes.advance([state], row[None], [Decoding(steps=2)])
        states.append(state)
    grids = {name: np.stack([each.tokens[name] for each in states])[None] for name in ("rgb", "depth")}
    tokens = {name: grid.reshape(1, FRAMES, arch.grid, arch.grid) for name, grid in grids.items()}
    inputs = jnp.asarray(model.assets.normalization.action_inputs(actions[None], False))
    scores: Any = score_tokens(arch, family.config.sample, model.params, tokens, inputs, np.zeros(1, bool), 1)
    made: list[Any] = [each.features for each in states[1:]]
    np.testing.assert_allclose(np.stack(made), scores.features[0], rtol=1e-3, atol=1e-4)
    assert states[0].features is None


def test_tokens_carry_success_only_where_the_data_set_knows_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = toy.store(tmp_path / "known")
    records = [toy.clip(0), toy.clip(1)]
    meta = {name: value for name, value in known.manifest.items() if name not in ("success_share", "splits")}
    splits = {split: map(encode_clip, records) for split in ("train", "test")}
    write_store(tmp_path / "unknown", "clips", splits, meta | {"key": "other"})
    cfg = toy.with_model(toy.config(), state_heads=StateHeadsConfig())
    model = create_model(cfg)
    for store, says in ((known, True), (open_store(tmp_path / "unknown"), False)):
        tokens = model.prepare(store, toy.assets(store), tmp_path, 0.0)
        assert tokens is not None
        arrays = model.transform(toy.assets(store).normalization)(tokens.source("train")[0], np.random.default_rng(0))
        assert np.isnan(arrays["state"][:, 0]).all() != says
        assert np.isnan(arrays["state"][:, 1:]).all()
        capsys.readouterr()
        model.check_clips(tokens)
        assert ("label of success" in capsys.readouterr().out) != says


def test_labels_that_clips_lack_are_named(
    model: TrainedModel, clips: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    create_model(toy.config()).check_clips(clips)
    assert not capsys.readouterr().out
    model.model.check_clips(clips)
    told = capsys.readouterr().out
    assert "3 of 3 training clips have no label of height" in told
    assert "label of success" not in told
