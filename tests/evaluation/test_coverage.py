"""Distances from the training clips against brute-force loops, and the bank that a run keeps."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import SampleConfig
from rsjax.config.config_fields import with_values
from rsjax.data.store import Store
from rsjax.evaluation.coverage import NEAREST, Coverage, clip_distances, features_of, make_coverage, read_coverage
from rsjax.evaluation.metrics.coverage import coverage as score
from rsjax.evaluation.registry import Familiarity, Scene, Unavailable
from rsjax.models.roboscape.teacher_forcing import score_tokens
from rsjax.models.roboscape.transformer import run_with_trunk
from rsjax.models.trained import TrainedModel
from rsjax.tools.play.play_run import PlayRun
from rsjax.tools.policies.run_data import RunData
from rsjax.tools.policies.studies.policy_evaluation import covered
from rsjax.tools.policies.worlds.model_world import FirstFrame, ModelWorld
from rsjax.tools.policies.worlds.world import run_episodes
from tests.models.roboscape.test_state_heads import WHOLE
from tests.models.roboscape.toy_sample import BATCH, given, random_params
from tests.tools.pipeline import toy

CLIPS = 6
FRAMES = 4
WIDTH = 5
ACTIONS = 3


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return toy.store(tmp_path_factory.mktemp("toy") / "clips")


@pytest.fixture(scope="module")
def trained(store: Store) -> TrainedModel:
    return toy.trained(store)


def parts(seed: int, clips: int = CLIPS, frames: int = FRAMES) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(3, 2, (clips, frames, WIDTH)), rng.normal(-1, 0.5, (clips, frames, ACTIONS))


def by_hand(row: np.ndarray, bank: list[np.ndarray]) -> float:
    return float(np.mean(sorted(np.sqrt(np.sum((row - other) ** 2)) for other in bank)[:NEAREST]))


def test_distances_are_those_of_a_loop_over_all_frames_of_other_clips() -> None:
    features, actions = parts(0)
    bank = Coverage.of(features, actions)
    rows = []
    for x in (features, actions):
        flat = x.reshape(-1, x.shape[-1])
        rows.append((flat - flat.mean(0)) / flat.std(0) / np.sqrt(x.shape[-1]))
    known = np.concatenate(rows, axis=1)
    owner = np.repeat(np.arange(CLIPS), FRAMES)
    apart = [by_hand(row, list(known[owner != own])) for row, own in zip(known, owner, strict=True)]
    np.testing.assert_allclose(bank.frame_distances, np.sort(apart), rtol=1e-4)
    clips = np.reshape(apart, (CLIPS, FRAMES)).mean(1)
    np.testing.assert_allclose(bank.clip_distances, np.sort(clips), rtol=1e-4)

    new_features, new_actions = parts(1, clips=2)
    found = bank.distances(new_features, new_actions)
    for clip, t in np.ndindex(2, FRAMES):
        new = []
        for x, of in ((new_features, features), (new_actions, actions)):
            flat = of.reshape(-1, of.shape[-1])
            new.append((x[clip, t] - flat.mean(0)) / flat.std(0) / np.sqrt(x.shape[-1]))
        assert found[clip, t] == pytest.approx(by_hand(np.concatenate(new), list(known)), rel=1e-4)

    ratio, percentile = bank.of_clips(np.array([np.median(clips), 0.0, clips.max() + 1]))
    np.testing.assert_allclose(ratio, [1, 0, (clips.max() + 1) / np.median(clips)], rtol=1e-4)
    assert percentile.tolist() == [0.5, 0, 1]
    assert bank.of_frames(np.array(np.max(apart) + 1))[1] == 1


@pytest.mark.parametrize(("clips", "frames"), [(2, 3), (3, 2), (4, 1)])
def test_of_few_frames_as_many_count_as_other_clips_have(clips: int, frames: int) -> None:
    features, actions = parts(0, clips, frames)
    bank = Coverage.of(features, actions)
    assert np.isfinite(bank.frame_distances).all()
    _, percentile = bank.of_frames(bank.distances(features + 100, actions + 100))
    assert (percentile == 1).all()  # far away


def test_a_number_that_hardly_varies_is_not_amplified() -> None:
    features, actions = parts(2)
    actions[..., 0] = 0.5
    bank = Coverage.of(features, actions)
    moved = actions[:1] + np.array([1e-4, 0, 0])
    near = bank.distances(features[:1], moved) - bank.distances(features[:1], actions[:1])
    assert np.abs(near).max() < 0.1


def test_features_are_those_of_a_full_pass_before_the_frame_is_seen() -> None:
    params = random_params(WHOLE)
    tokens, actions = given(WHOLE, 6, 6)
    visible = np.zeros(tokens["rgb"].shape, bool)
    _, _, trunk = run_with_trunk(WHOLE, params, tokens, visible, actions)
    sample = SampleConfig(steps=1)
    found = score_tokens(WHOLE, sample, params, tokens, jnp.asarray(actions), np.zeros(BATCH, bool), 1).features
    np.testing.assert_allclose(found, np.asarray(trunk)[:, 1:].mean(2), rtol=1e-3, atol=1e-4)  # type: ignore[arg-type]


def test_a_run_makes_its_bank_once(store: Store, trained: TrainedModel, tmp_path: Path) -> None:
    assert read_coverage(trained, store, tmp_path) is None
    made = make_coverage(trained, store, tmp_path)
    assert made is not None
    file = tmp_path / "coverage" / "bank.msgpack"
    written = file.stat().st_mtime_ns
    sampled = replace(trained, config=with_values(trained.config, {"model.sample.steps": 3}))
    again = make_coverage(sampled, store, tmp_path)  # features do not depend on sampling
    assert file.stat().st_mtime_ns == written
    np.testing.assert_array_equal(again.frames, made.frames)  # type: ignore[union-attr]
    for damage in (Path.unlink, lambda path: path.write_bytes(b"cut")):
        damage(file)
        assert read_coverage(trained, store, tmp_path) is None
        np.testing.assert_array_equal(make_coverage(trained, store, tmp_path).frames, made.frames)  # type: ignore[union-attr]
    other = replace(trained, params={**trained.params, "more": np.ones(1)})
    assert read_coverage(other, store, tmp_path) is None

    clips = [store.source("train")[number] for number in range(2)]
    video = Video(np.stack([clip["rgb"] for clip in clips]), np.stack([clip["depth"] for clip in clips]))
    actions = np.stack([clip["actions"] for clip in clips])
    features = features_of(trained, video, actions, 1)
    assert features is not None
    frames = made.distances(features, actions[:, 1:])
    found = clip_distances(trained, made, video, actions, [3, 6])
    np.testing.assert_allclose(found, [frames[0, :2].mean(), frames[1].mean()])

    data = RunData(tmp_path)
    data.__dict__.update(trained=trained, clips=store, config=trained.config)
    played = PlayRun(data).coverage
    assert played is not None
    np.testing.assert_array_equal(played.frame_distances, made.frame_distances)


def test_the_metric_reports_distance_percentile_and_the_correlation_with_errors() -> None:
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (5, 3, 8, 8, 3), np.uint8)
    noise = np.array([1, 2, 4, 8, 16])
    wrong = np.clip(truth + noise[:, None, None, None, None] * rng.choice([-1, 1], truth.shape), 0, 255)
    far = np.array([0.5, 1.0, 0.8, 2.0, 3.0])
    familiarity = Familiarity(far, far / 4)
    scores: Any = score(Scene(Video(truth), Video(wrong.astype(np.uint8)), familiarity=familiarity))
    np.testing.assert_array_equal(scores[""], far)
    np.testing.assert_allclose(scores["_percentile"], 25 * far)
    assert scores["_error_correlation"] == pytest.approx(0.9)  # two of five ranks are swapped
    alike = replace(familiarity, coverage=np.ones(5))
    scores = score(Scene(Video(truth), Video(wrong.astype(np.uint8)), familiarity=alike))
    assert "_error_correlation" not in scores
    with pytest.raises(Unavailable):
        score(Scene(Video(truth), Video(truth)))


def test_episodes_of_a_world_are_measured_up_to_their_ends(store: Store, trained: TrainedModel, tmp_path: Path) -> None:
    bank = make_coverage(trained, store, tmp_path)
    assert bank is not None
    clip = store.source("test")[0]
    start = FirstFrame(clip["rgb"][0], clip["depth"][0], 0)
    rng = np.random.default_rng(0)
    world = ModelWorld(trained, 2, None, coverage=bank)
    episodes = run_episodes(world, lambda seen: rng.uniform(-1, 1, (2, 28)), [start, start], 5)
    short = replace(episodes[1], rgb=episodes[1].rgb[:4], depth=episodes[1].depth[:4], actions=episodes[1].actions[:4])  # type: ignore[index]
    found = world.unfamiliarity([episodes[0], short], 6)
    for episode, percentile in zip((episodes[0], short), found, strict=True):
        video = Video(episode.rgb[None], episode.depth[None])  # type: ignore[index]
        far = clip_distances(trained, bank, video, episode.actions[None], [len(episode.rgb)])
        assert percentile == bank.of_clips(far)[1][0]
    assert ModelWorld(trained, 2, None).unfamiliarity(episodes, 6) == []


def test_outcomes_are_compared_where_the_model_has_seen_the_like_and_where_not() -> None:
    one = {
        "unfamiliarity": [0.2, 0.995, 1.0, 0.5],
        "simulator": [True, False],
        "world_model": [True, True, True, False],
    }
    two = {
        "unfamiliarity": [0.999, 0.1, 0.1, 0.1],
        "simulator": [False, True],
        "world_model": [False, False, True, True],
    }
    assert covered([one, two]) == {
        "episodes": 8,
        "unseen": 3,
        "same_outcome": {"seen": [1, 2], "unseen": [1, 2]},
    }
    assert covered([one, two | {"unfamiliarity": []}]) is None
