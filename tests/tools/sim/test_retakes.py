"""Second takes of simulated clips."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsjax.config import SimConfig, to_dict
from rsjax.data.store import Store, encode_clip, open_store, write_store
from rsjax.errors import UserError
from rsjax.tools.sim import retakes
from rsjax.tools.sim.collect import Collection, Report
from rsjax.tools.sim.episode import EpisodePlan, run_episode, source_name
from rsjax.tools.sim.lift import LiftSim
from rsjax.tools.sim.recipes.plans import scripted
from rsjax.tools.sim.retakes import collect_retakes
from rsjax.tools.sim.unseen import UNITS

CONFIG = SimConfig(episodes=4, test_episodes=2, frames=4, tracks=20, seed=5)


def ignore(done: int, total: int) -> None:
    pass


@pytest.fixture
def store(sim: LiftSim, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Store:
    """Two test clips, one with other colours; second takes are simulated in this process."""
    plans = EpisodePlan("2", 2), EpisodePlan("3", 3, change="color")
    meta: dict[str, object] = {name: [0.0, 1.0] for name in UNITS}
    meta |= {"key": "clips", "source": source_name(CONFIG), "config": to_dict(CONFIG)}
    write_store(tmp_path / "lift", "clips", {"test": (encode_clip(run_episode(sim, CONFIG, p)) for p in plans)}, meta)

    def make(what: Collection, out: Path, report: Report, workers: int) -> None:
        clips = {
            split: (encode_clip(run_episode(sim, what.config, p)) for p in of) for split, of in what.splits.items()
        }
        write_store(out, "clips", clips, {"key": what.key} | dict(what.meta))

    monkeypatch.setattr(retakes, "make_store", make)
    return open_store(tmp_path / "lift")


def test_second_takes_start_alike_and_move_a_little_otherwise(store: Store) -> None:
    source = store.source("test")
    takes = collect_retakes(store, "test", [1, 0], 1, ignore)
    for number, take in zip((1, 0), takes, strict=True):
        clip = source[number]
        assert take["provenance"]["episode"] == clip["provenance"]["episode"]
        assert take["provenance"].get("unseen") == clip["provenance"].get("unseen")
        assert take["provenance"]["replay"] == {"jitter": retakes.JITTER}
        np.testing.assert_array_equal(take["rgb"][0], clip["rgb"][0])
        assert (take["rgb"][-1] != clip["rgb"][-1]).any()
        apart = (take["actions"] - clip["actions"])[1:]
        inside = np.abs(clip["actions"][1:]) < 0.8
        assert np.abs(take["actions"]).max() <= 1
        assert apart[inside].std() == pytest.approx(retakes.JITTER, rel=0.25)
    assert open_store(next((store.path / retakes.FOLDER).iterdir())).manifest["retakes"] == {
        "of": "clips",
        "split": "test",
        "jitter": retakes.JITTER,
    }


def test_second_takes_of_paired_clips_do_not_take_each_others_place(sim: LiftSim, store: Store, tmp_path: Path) -> None:
    pair = [scripted(CONFIG, "grasps", place, f"pair-{place}") for place in range(2)]
    assert pair[0].episode == pair[1].episode
    clips = [encode_clip(run_episode(sim, CONFIG, plan)) for plan in pair]
    meta = {name: value for name, value in store.manifest.items() if name != "splits"}
    write_store(tmp_path / "pair", "clips", {"pair": iter(clips)}, meta)
    takes = collect_retakes(open_store(tmp_path / "pair"), "pair", [1, 0], 1, ignore)
    assert [take["provenance"]["expert"] for take in takes] == [clip["provenance"]["expert"] for clip in clips[::-1]]
    assert [take["provenance"]["difficulty"] for take in takes] == ["difficult"] * 2


def test_clips_of_another_simulator_or_of_none_are_refused(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = EpisodePlan("x", 2, change="camera")  # starts otherwise, as in another version of the simulator
    monkeypatch.setattr(retakes, "_plan", lambda *_: other)
    with pytest.raises(UserError, match="second take of episode 2 starts otherwise than the clip"):
        collect_retakes(store, "test", [0], 1, ignore)
    monkeypatch.setattr(retakes, "_plan", lambda *_: EpisodePlan("x", 0))
    with pytest.raises(UserError, match="the simulator failed at the second take of episode 2; score without them"):
        collect_retakes(store, "test", [0, 0], 1, ignore)
    plain = replace(store, manifest={k: v for k, v in store.manifest.items() if k != "config"})
    with pytest.raises(UserError, match="these clips were not simulated"):
        collect_retakes(plain, "test", [0], 1, ignore)


def test_clips_from_the_middle_of_an_episode_have_no_second_takes(store: Store, tmp_path: Path) -> None:
    record = store.source("test")[0]
    record["provenance"]["window"] = 2
    write_store(tmp_path / "late", "clips", {"test": [record]}, store.manifest)
    with pytest.raises(UserError) as refused:
        collect_retakes(open_store(tmp_path / "late"), "test", [0], 1, ignore)
    assert "begin in the middle of an episode" in str(refused.value)
