"""Episodes of policies as clips for a world model."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsjax.data.state_labels import knows_success
from rsjax.data.store import encode_clip, open_store, write_store
from rsjax.errors import UserError
from rsjax.tools.policies.on_policy import act, cut, windows
from tests.tools.pipeline import toy as clips
from tests.tools.policies.toy_worlds import ToyPolicy, simulated


def episode(frames: int = 6) -> dict[str, Any]:
    """An episode whose values tell its frames apart."""
    record = encode_clip(clips.clip(0))
    record["provenance"] |= {"objects": {"cube": [[t, t] for t in range(6)], "cube_width": 0.1}}
    return record


def test_windows_cover_an_episode_and_begin_without_an_action() -> None:
    record = episode()
    first, second = windows(record, 4)
    assert (first["provenance"]["window"], second["provenance"]["window"]) == (0, 2)
    for clip, start in ((first, 0), (second, 2)):
        span = slice(start, start + 4)
        for name in ("rgb", "depth", "success"):
            np.testing.assert_array_equal(clip[name], record[name][span])
        for name in ("tracks", "visible"):
            np.testing.assert_array_equal(clip[name], record[name][:, span])
        np.testing.assert_array_equal(clip["actions"][1:], record["actions"][span][1:])
        assert not clip["actions"][0].any()
        assert clip["provenance"]["objects"] == {"cube": [[t, t] for t in range(6)][span], "cube_width": 0.1}
    assert record["actions"][2].any() and len(record["rgb"]) == 6  # the episode stays as it was
    assert [clip["provenance"]["window"] for clip in windows(record, 3)] == [0, 2, 3]
    record["provenance"]["window"] = 17  # itself from the middle of an episode
    assert [clip["provenance"]["window"] for clip in windows(record, 3)] == [17, 19, 20]
    (whole,) = windows(record, 6)
    np.testing.assert_array_equal(whole["rgb"], record["rgb"])


def test_a_policy_acts_on_after_its_success_and_an_interrupted_call_resumes(tmp_path: Path) -> None:
    policy: Any = ToyPolicy(1.0)
    seeds = [0, 1, 2, 3, 4, 5]
    whole = act(policy, simulated(4), seeds, 7, tmp_path / "actions", "acting")
    assert len(whole) == 6 and {rows.shape for rows in whole} == {(8, 6)}
    assert all(not rows[0].any() and (rows[1:, 0] == 1).all() for rows in whole)
    (tmp_path / "actions" / "00004.actions").unlink()
    begun = (tmp_path / "actions" / "00000.actions").stat().st_mtime_ns
    again = act(policy, simulated(4), seeds, 7, tmp_path / "actions", "acting")
    np.testing.assert_array_equal(whole, again)
    assert (tmp_path / "actions" / "00000.actions").stat().st_mtime_ns == begun


def test_episodes_become_clips_in_the_units_of_the_models_own(tmp_path: Path) -> None:
    own = clips.store(tmp_path / "own")
    meta: dict[str, Any] = {"depth_range": [0.1, 9.0], "action_mean": [5.0], "action_std": [5.0]}
    unlabelled = meta | {"key": "unlabelled"}
    meta |= {"key": "episodes", "success_share": 1 / 3}
    long = [encode_clip(clips.clip(number, success=number == 1)) for number in range(3)]
    write_store(tmp_path / "episodes", "clips", {"train": long[:2], "test": long[2:]}, meta)
    episodes = open_store(tmp_path / "episodes")
    made = cut(episodes, own, 4, tmp_path / "cut")
    assert made.counts() == {"train": 4, "test": 2}
    for name in ("depth_range", "action_mean", "action_std"):
        assert made.manifest[name] == own.manifest[name]
    assert made.manifest["success_share"] == pytest.approx(1 / 6)
    assert cut(episodes, own, 4, tmp_path / "cut").manifest == made.manifest
    write_store(tmp_path / "unlabelled", "clips", {"train": long}, unlabelled)
    assert not knows_success(cut(open_store(tmp_path / "unlabelled"), own, 4, tmp_path / "cut unlabelled"))
    for frames, wrong in ((7, "an episode has 6 frames; the model's clips have 7"),):
        with pytest.raises(UserError) as error:
            cut(episodes, own, frames, tmp_path / "wrong")
        assert wrong in str(error.value)
    narrow = [record | {"actions": record["actions"][:, :3]} for record in long]
    write_store(tmp_path / "narrow", "clips", {"train": narrow}, meta)
    with pytest.raises(UserError) as error:
        cut(open_store(tmp_path / "narrow"), own, 4, tmp_path / "wrong")
    assert "(64, 3, 64, 'metres'), those of the model's clips (64, 28, 64, 'metres')" in str(error.value)
