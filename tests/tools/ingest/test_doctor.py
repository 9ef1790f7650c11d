import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.config import ConfigError
from rsjax.processes import WorkerDied
from rsjax.tools.ingest import doctor
from rsjax.tools.ingest.doctor import KINDS, Thresholds, diagnose, quaternions, select, write_selection
from rsjax.tools.ingest.episode import Episode, EpisodeError, Segment, SourceError
from rsjax.tools.ingest.formats import open_source
from tests.tools.ingest.formats.test_folder import write_episode
from tests.tools.ingest.toy_source import COUNT, Pictures, ToySource, episode, pictures, source

Change = Callable[[Episode], dict[str, Any]]
ODD = 6  # the number of the changed episode


def changed(array: np.ndarray | None, place: Any, value: float) -> np.ndarray:
    assert array is not None
    copy = array.copy()
    copy[place] = value
    return copy


def flipped(rows: np.ndarray | None) -> np.ndarray:
    assert rows is not None
    return np.concatenate([rows[:, :3], rows[:, 3:] * np.where(np.arange(COUNT) < 7, 1, -1)[:, None]], 1)


CASES: list[tuple[str, str, Change]] = [
    ("camera", "has no hand", lambda e: {"cameras": {"front": e.cameras["front"]}}),
    ("camera", "front: frame 0 is of one colour", lambda e: {"cameras": {**e.cameras, "front": Pictures(_zeros())}}),
    ("camera", "hand: 5 pictures are all the same", lambda e: {"cameras": {**e.cameras, "hand": Pictures(_still())}}),
    (
        "undecodable",
        "front: a.mp4: frame 11",
        lambda e: {"cameras": {**e.cameras, "front": Pictures(pictures(9), [11])}},
    ),
    ("length", "front has 9 rows, timestamps 12", lambda e: {"cameras": {"front": Pictures(pictures(9)[:9])}}),
    ("length", "has 1 frame", lambda e: _first_frame(e)),
    ("not-finite", "actions of frame 4", lambda e: {"actions": changed(e.actions, (4, 2), np.nan)}),
    ("time", "not increase at frame 4", lambda e: {"timestamps": changed(e.timestamps, 4, 0.1)}),
    ("time", "1.2 s before frame 6", lambda e: {"timestamps": e.timestamps + np.where(np.arange(COUNT) > 5, 1, 0)}),
    ("time", "frames are 0.2 s apart .median., fps is 30", lambda e: {"fps": 30.0}),
    ("action", "all are zero", lambda e: {"actions": np.zeros_like(e.actions)}),
    ("action", "dimension 2 reaches 300", lambda e: {"actions": changed(e.actions, (5, 2), 300)}),
    ("action", "has 7 dimensions, most episodes have 8", lambda e: {"actions": e.actions[:, :7]}),
    ("action", "should be a unit quaternion", lambda e: {"meta": {"actions": {"quaternions": [2]}}}),
    ("state", "dimension 1 jumps by", lambda e: {"states": changed(e.states, (5, 1), 400)}),
    ("quaternion-flip", "dimensions 3 to 6 at frame 7", lambda e: {"states": flipped(e.states)}),
    ("depth", "frame 11 has values that are negative", lambda e: {"depth": {"front": Pictures(_depth(-1.0))}}),
    ("depth", "frame 11 has no value above 0", lambda e: {"depth": {"front": Pictures(_depth(0.0))}}),
    ("segment", "'grasp' goes from 10 to 13", lambda e: {"segments": (Segment(10, 13, "grasp"),)}),
    ("no-task", "empty", lambda e: {"task": " "}),
    ("duplicate", "are those of episode-2", lambda e: replace(episode(2), id=e.id).__dict__),
    ("duplicate", "another episode has the same id", lambda e: {"id": "episode-2"}),
]


def _zeros() -> np.ndarray:
    return np.zeros((COUNT, 4, 4, 3), np.uint8)


def _still() -> np.ndarray:
    return np.repeat(pictures(9)[:1], COUNT, 0)


def _first_frame(e: Episode) -> dict[str, Any]:
    rows = {name: getattr(e, name)[:1] for name in ("timestamps", "actions", "states")}
    return {**rows, "cameras": {"front": Pictures(pictures(9)[:1]), "hand": Pictures(pictures(8)[:1])}, "depth": {}}


def _depth(last: float) -> np.ndarray:
    return changed(np.ones((COUNT, 4, 4), np.float32), -1, last)


@pytest.mark.parametrize(("kind", "detail", "change"), CASES, ids=[detail[:30] for _, detail, _ in CASES])
def test_a_problem_is_found_where_it_is(kind: str, detail: str, change: Change) -> None:
    odd = episode(ODD)
    diagnosis = diagnose(source(replace(odd, **change(odd))), Thresholds())
    found = [finding for finding in diagnosis.findings if finding.kind == kind]
    assert any(re.search(detail, finding.detail) for finding in found)
    assert {finding.episode for finding in diagnosis.findings} <= {f"episode-{ODD}", "episode-2"}
    assert "episode-2" not in diagnosis.reasons() or detail.startswith("another")


def test_an_angle_that_passes_pi_does_not_jump() -> None:
    def turning(seed: int, across: float) -> Episode:
        made = episode(seed)
        yaw = across + np.linspace(-0.05, 0.05, COUNT)
        yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
        return replace(made, states=np.stack([yaw, yaw], 1).astype(np.float32))

    episodes = [turning(seed, 1.0) for seed in range(6)]
    assert not diagnose(ToySource((*episodes, turning(6, np.pi))), Thresholds()).findings


def test_every_kind_is_tried() -> None:
    assert {kind for kind, _, _ in CASES} | {"unreadable", "seeking"} == set(KINDS)  # test_video_order.py


@pytest.mark.parametrize(
    ("error", "kind", "detail"),
    [
        (EpisodeError("a.h5: truncated"), "unreadable", "a.h5: truncated"),
        (EpisodeError("a.h5:\n\nwrong", "undecodable"), "undecodable", "a.h5: wrong"),
        (ZeroDivisionError("a surprise"), "unreadable", "a surprise"),
    ],
)
def test_an_unreadable_episode_does_not_hide_the_others(error: Exception, kind: str, detail: str) -> None:
    diagnosis = diagnose(source(error, replace(episode(7), task="")), Thresholds())
    found = [(finding.episode, finding.kind) for finding in diagnosis.findings]
    assert found == [("episode-6", kind), ("episode-7", "no-task")]
    assert detail in diagnosis.findings[0].detail


def test_all_pictures_can_be_decoded() -> None:
    odd = replace(episode(ODD), cameras={"front": Pictures(pictures(9), [5]), "hand": Pictures(pictures(8))})
    assert not diagnose(source(odd), Thresholds(frames=2)).findings
    for frames in (0, 9, 10**8):
        assert diagnose(source(odd), Thresholds(frames=frames)).counts() == {"undecodable": 1}


def test_several_processes_find_the_same() -> None:
    data_set = source(EpisodeError("a.h5: truncated"), replace(episode(7), task=""), episode(2), fine=4)
    assert diagnose(data_set, Thresholds(), workers=2) == diagnose(data_set, Thresholds())


def test_an_episode_over_which_workers_die_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def run_items(make: Any, items: Any, workers: int, settle: Any) -> None:
        for item in reversed(list(items)):
            settle(item, WorkerDied() if item[0] == 2 else make()(item))

    monkeypatch.setattr(doctor, "run_items", run_items)
    diagnosis = diagnose(source(), Thresholds(), workers=2)
    assert [name for name, _ in diagnosis.refs] == [f"episode-{number}" for number in range(6)]
    ((name, detail),) = diagnosis.reasons().items()
    assert name == "episode-2" and detail[0].startswith("unreadable: 2 workers died over it")


@pytest.mark.parametrize("limits", [{"frames": -1}, {"gap": 0.5}, {"unusual": 1}])
def test_impossible_limits_are_refused(limits: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=f"{next(iter(limits))} is "):
        Thresholds(**limits)


def test_ignored_kinds_are_left_out() -> None:
    odd = replace(episode(ODD), task="")
    assert not diagnose(source(odd), Thresholds(), ["no-task"]).findings
    with pytest.raises(SourceError, match="no kind 'no-tsk' to ignore; did you mean 'no-task'"):
        diagnose(source(odd), Thresholds(), ["no-tsk"])


def test_a_data_set_without_episodes_is_refused() -> None:
    with pytest.raises(SourceError, match="toy: the data set has no episodes"):
        diagnose(ToySource(()), Thresholds())


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1), st.integers(0, 3), st.integers(0, 3))
def test_quaternions_are_recognised_among_other_numbers(seed: int, before: int, after: int) -> None:
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(6, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    rows = np.concatenate([rng.uniform(1, 2, (6, before)), turns, rng.uniform(1, 2, (6, after))], axis=1)
    assert quaternions(rows) == [before]


def test_a_gripper_after_zeros_is_no_quaternion() -> None:
    rows = np.zeros((6, 7))
    rows[:, 6] = [-1, -1, 1, 1, -1, 1]
    assert quaternions(rows) == []
    odd = episode(ODD)
    gripper = replace(
        odd, actions=changed(odd.actions, (slice(None), slice(4, 8)), 0.5), meta={"actions": {"held": [7]}}
    )
    gripper.actions[6:, 4:] *= -1
    assert "quaternion-flip" not in diagnose(source(gripper), Thresholds()).counts()
    assert "quaternion-flip" in diagnose(source(replace(gripper, meta={})), Thresholds()).counts()


def test_what_a_reader_mended_is_noted_and_no_finding() -> None:
    notes = {"empty": ["state/waist"], "scattered": {"end": 3}, "depth_left_out": "7 maps for 8 frames"}
    diagnosis = diagnose(source(replace(episode(ODD), meta={"notes": notes})), Thresholds())
    assert not diagnosis.findings
    assert diagnosis.mended == (
        ("episode-6", "empty: state/waist; scattered: end 3; depth left out: 7 maps for 8 frames"),
    )


def test_damaged_files_are_findings_and_left_out(tmp_path: Path) -> None:
    data_set = tmp_path / "set"
    for name in ("one", "cut", "nan", "other", "short", "still", "twin"):
        write_episode(data_set, name)
        (data_set / name / "actions.csv").write_text(
            "timestamp,x\n" + "".join(f"{row / 10},{row + (name == 'other')}\n" for row in range(8))
        )
    payload = (data_set / "cut" / "front.mp4").read_bytes()
    (data_set / "cut" / "front.mp4").write_bytes(payload[: len(payload) // 2])
    (data_set / "nan" / "actions.csv").write_text("x\n" + "1\n" * 3 + "nan\n" + "1\n" * 4)
    (data_set / "short" / "actions.csv").write_text("x\n" + "1\n" * 5)
    (data_set / "still" / "actions.csv").write_text("timestamp,x\n" + "0,1\n" * 8)
    (data_set / "dataset.json").write_text('{"task": "go"}')
    read = open_source("folder", data_set)
    diagnosis = diagnose(read, Thresholds())
    assert {finding.episode: finding.kind for finding in diagnosis.findings} == {
        "cut": "undecodable",
        "nan": "not-finite",
        "short": "length",
        "still": "time",
        "twin": "duplicate",
    }
    assert write_selection(tmp_path / "m.json", "set", diagnosis.refs, diagnosis.reasons()) == (2, 5)
    chosen = select(read, tmp_path / "m.json")
    good = [ref.id for ref in chosen.episodes() if "left_out" not in ref.location]
    assert good == ["one", "other"] and len(list(chosen.episodes())) == len(diagnosis.refs) == 7


def test_episodes_of_one_name_are_all_counted_and_left_out(tmp_path: Path) -> None:
    diagnosis = diagnose(source(replace(episode(7), id="episode-2")), Thresholds())
    assert diagnosis.counts() == {"duplicate": 2}
    assert write_selection(tmp_path / "m.json", "toy", diagnosis.refs, diagnosis.reasons()) == (5, 2)


def test_the_fix_leaves_out_the_bad_ones_with_reasons_and_counts_them(tmp_path: Path) -> None:
    data_set = source(replace(episode(6), task=""), episode(7))
    diagnosis = diagnose(data_set, Thresholds())
    assert write_selection(tmp_path / "m.json", "toy", diagnosis.refs, diagnosis.reasons()) == (7, 1)
    chosen = select(data_set, tmp_path / "m.json")
    refs = list(chosen.episodes())
    assert [ref.id for ref in refs] == [f"episode-{number}" for number in range(8)]
    assert [chosen.read(ref).id for ref in refs if ref.id != "episode-6"] == [r.id for r in refs if r.id != "episode-6"]
    with pytest.raises(EpisodeError, match="episode-6: left out by the list: no-task: its task is empty"):
        chosen.read(refs[6])
    plain = {ref.id: ref.fingerprint for ref in data_set.episodes()}
    assert [ref.id for ref in refs if ref.fingerprint != plain[ref.id]] == ["episode-6"]


def test_an_episode_that_was_mended_is_read_again(tmp_path: Path) -> None:
    bad = replace(episode(6), task="")
    diagnosis = diagnose(source(bad), Thresholds())
    write_selection(tmp_path / "m.json", "toy", diagnosis.refs, diagnosis.reasons())
    mended = select(source(replace(bad, task="lift", fingerprint="0" * 16)), tmp_path / "m.json")
    assert [mended.read(ref).task for ref in mended.episodes()][6] == "lift"


def test_a_list_of_something_else_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.json"
    diagnosis = diagnose(source(), Thresholds())
    write_selection(path, "toy", diagnosis.refs, diagnosis.reasons())
    whole = path.read_text()
    write_selection(path, "toy", (("other", "0" * 16),), {})
    of_another = path.read_text()
    others = ToySource(tuple(replace(episode(seed), fingerprint="1" * 16) for seed in range(6)))
    no_lists = ("", "[]", "{}", '{"format": 2}', '{"format": 1, "kept": 3, "left_out": []}', "[" * 100_000)
    for data_set, content, message in (
        (source(), None, "not there"),
        (others, whole, "the data set was read with other options then"),
        (source(), of_another, "names no episode of this data set"),
        *((source(), content, "not a list of") for content in no_lists),
    ):
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_text(content)
        with pytest.raises(SourceError, match=f"m.json: {message}"):
            select(data_set, path)
