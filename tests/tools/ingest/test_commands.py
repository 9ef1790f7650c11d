"""``experiments.ingest``, ``experiments.inspect`` and ``experiments.store``, as a user types them."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from rsjax.data.store import open_store
from rsjax.tools.commands import doctor, ingest, inspect, store
from rsjax.tools.ingest.options import source_options
from tests.bridge import BRIDGE, needs_bridge
from tests.data.clips import clip_store, numbers
from tests.tools.ingest.formats.toy_tfrecord import bridge_episode, write_bridge


class Command:
    """Runs a command in this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch = monkeypatch
        self._capsys = capsys

    def __call__(self, module: ModuleType, *arguments: object) -> str:
        """What it prints."""
        self._monkeypatch.setattr(sys, "argv", [module.__name__, *map(str, arguments)])
        module.main()
        return self._capsys.readouterr().out

    def finding(self, module: ModuleType, *arguments: object) -> str:
        """What a command prints that ends with status 1."""
        with pytest.raises(SystemExit, match="1"):
            self(module, *arguments)
        return self._capsys.readouterr().out

    def refused(self, module: ModuleType, *arguments: object) -> str:
        """The one line on standard error of a command that cannot be carried out."""
        with pytest.raises(SystemExit, match="2"):
            self(module, *arguments)
        text = self._capsys.readouterr().err
        assert text.startswith("error: ") and text.count("\n") == 1
        return text


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(monkeypatch, capsys)


@needs_bridge
def test_the_bundled_bridge_episodes_become_a_store(command: Command, tmp_path: Path) -> None:
    out = tmp_path / "bridge"
    line = ["rlds", BRIDGE, "--out", out, "--windows.frames", 4, "--windows.rate", 0, "--windows.hop", 4]
    line += ["--workers", 0, "--difficulty", "put*=simple", "*=difficult", "--shots", "none", "--motion", "none"]
    text = command(ingest, *line)
    assert "episodes  25 = 25 with clips + 0 without + 0 quarantined" in text and str(out) in text
    opened = open_store(out)
    counts = opened.labels("train").counts()["difficulty"]
    assert set(counts) == {"simple", "difficult"}
    assert f"{out} is up to date" in command(ingest, *line)
    assert "nothing is quarantined" in command(ingest, *line, "--retry")

    assert "what was left out" not in text  # nothing was
    text = command(inspect, out)
    assert "float32 (4, 7)" in text and "put carrot on plate" in text
    sheet = cv2.imread(str(tmp_path / "bridge-sheet.png"))
    assert sheet is not None and sheet.shape[1] == 8 * 100 and sheet.std() > 20


def folder_of_episodes(place: Path, count: int, copies: tuple[int, ...] = ()) -> Path:
    """Episodes of 12 pictures at 10 fps; those in ``copies`` are the first one again."""
    for number in range(count):
        rng = np.random.default_rng(0 if number in copies else number)
        pictures = place / f"episode_{number:02d}" / "front"
        pictures.mkdir(parents=True)
        for frame in range(12):
            cv2.imwrite(str(pictures / f"{frame:06d}.png"), rng.integers(0, 255, (24, 32, 3), np.uint8))
        np.save(pictures.parent / "actions.npy", rng.normal(size=(12, 2)).astype(np.float32))
    (place / "dataset.json").write_text('{"task": "fold the towel", "fps": 10, "kind": "delta"}')
    return place


SMALL = ["--windows.rate", 0, "--windows.frames", 4]


def test_what_the_doctor_leaves_out_is_quarantined_with_its_reasons(command: Command, tmp_path: Path) -> None:
    source = folder_of_episodes(tmp_path / "source", 4, copies=(2,))
    command.finding(doctor, "folder", source, "--fix", tmp_path / "fixed.json")
    line = ["folder", source, "--out", tmp_path / "store", "--workers", 0, *SMALL]
    text = command(ingest, *line, "--selection", tmp_path / "fixed.json")
    assert "episodes  4 = 3 with clips + 0 without + 1 quarantined" in text
    rows = [json.loads(row) for row in (tmp_path / "store.work" / "quarantine.jsonl").read_text().splitlines()]
    assert [row["episode"] for row in rows] == ["episode_02"]
    assert "left out by the list: duplicate" in rows[0]["error"]
    manifest = open_store(tmp_path / "store").manifest
    assert "left out by the list" in manifest["quarantine"]["episode_02"]
    assert "episodes  4 = 4 with clips" in command(ingest, *line)


def test_the_doctors_status_and_its_list(command: Command, tmp_path: Path) -> None:
    fix = tmp_path / "m.json"
    line = ["rlds", tmp_path / "data"]
    write_bridge(tmp_path / "data", [bridge_episode(5), bridge_episode(4, task=""), b"\xff"])
    text = command.finding(doctor, *line, "--option", "split=train", "--fix", fix)
    assert "train-00000-00001: no-task" in text and "train-00000-00002: unreadable" in text
    assert "3 episodes: 1 without a finding, 2 with" in text
    left_out = [entry["id"] for entry in json.loads(fix.read_text())["left_out"]]
    assert left_out == ["train-00000-00001", "train-00000-00002"]

    write_bridge(tmp_path / "data", [bridge_episode(4, task=""), bridge_episode(5, task="")])
    text = command.finding(doctor, *line, "--fix", fix)
    assert "all are 'no-task': if that is as it should be, --ignore no-task" in text
    assert "keeps 0, leaves out 2; nothing is left to ingest: --ignore no-task, and write it again" in text
    assert f"{fix}: keeps 2, leaves out 0\n" in command(doctor, *line, "--fix", fix, "--ignore", "no-task")

    write_bridge(tmp_path / "data", [b"\xff", b"\xff\xff"])
    text = command.finding(doctor, *line, "--fix", fix)
    assert "unreadable" in text and "--ignore" not in text  # what makes everything unreadable is never to be ignored
    assert "keeps 0, leaves out 2; nothing is left to ingest: mend what is wrong, and write it again" in text


def test_the_papers_recipe_filters_windows_and_the_default_says_what_it_leaves_out(
    command: Command, tmp_path: Path
) -> None:
    """Nothing moves, so no window passes but by an option after the recipe."""
    source = folder_of_episodes(tmp_path / "source", 1)
    for picture in (source / "episode_00" / "front").glob("*.png"):
        cv2.imwrite(str(picture), np.full((24, 32, 3), 90, np.uint8))
    line = ["folder", source, "--out", tmp_path / "store", "--workers", 0, *SMALL, "--shots", "none"]
    text = command(ingest, *line)
    assert "filters   off: windows of one action, a key frame in each, clear motion; --recipe paper turns them" in text
    assert "testing   no clip is left for it, and training needs two: add episodes\n" in text  # there is but one
    assert "pictures  of 1 episodes, 32 × 24 cropped to the middle square" in text
    assert "9 still" in command.refused(ingest, *line, "--recipe", "paper")
    text = command(ingest, *line, "--recipe=paper", "--windows.least-motion", 0, "--windows.no-key-frame")
    assert "windows   9 = 9 kept" in text and "filters   off: a key frame in each\n" in text
    assert "cuts" not in text


def test_a_clip_keeps_the_original_name_of_its_episode(command: Command, tmp_path: Path) -> None:
    source = folder_of_episodes(tmp_path / "source", 1)
    name = os.fsdecode("Falten und Öffnen 折る ".encode() + b"\xff")
    (source / "episode_00").rename(source / name)
    command(ingest, "folder", source, "--out", tmp_path / "store", "--workers", 0, *SMALL)
    provenance = open_store(tmp_path / "store").source("train")[0]["provenance"]
    assert provenance["origin"] == {"name": "Falten und Öffnen 折る \\udcff", "flat": False}
    assert provenance["episode"].isascii()


def test_a_command_that_is_stopped_goes_on(command: Command, tmp_path: Path) -> None:
    source = folder_of_episodes(tmp_path / "source", 24)
    line = ["folder", source, "--out", tmp_path / "store", *SMALL]
    words = [sys.executable, "-m", "experiments.ingest", *map(str, line), "--workers", "1"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        while not list(tmp_path.glob("store.work/items/**/*.json")):
            assert process.poll() is None
            time.sleep(0.01)
        process.terminate()
        _, text = process.communicate()
    assert process.returncode == 75 and text.count("\n") == 1 and "the same command resumes" in text
    marks = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("items/**/*.json")}
    # All 120 are there if the machine was so busy that the signal came while the clips were packed.
    assert 0 < len(marks) <= 120 and not (tmp_path / "store").exists()
    text = command(ingest, *line, "--workers", 0, "--keep-clips")
    assert f"this run  {120 - len(marks)} work items" in text
    assert {path: path.stat().st_mtime_ns for path in marks} == marks


def test_the_help_says_what_source_and_path_are(command: Command, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        command(ingest, "--help")
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert (
        "agibot, lerobot, robomimic, libero, rlds, bair, folder, npz, sim" in text
        and "PATH is the folder or file" in text
    )


def test_undeclared_actions_stop_an_ingest_before_it_annotates_and_inspect_names_dimensions(
    command: Command, tmp_path: Path
) -> None:
    source = folder_of_episodes(tmp_path / "source", 3)
    (source / "episode_00" / "actions.npy").unlink()  # which does not hide what is wrong with the others
    (source / "dataset.json").write_text('{"fps": 10}')
    line = ["folder", source, "--out", tmp_path / "store", "--workers", 0, "--shots", "none", "--windows.frames", 3]
    text = command.refused(ingest, *line, "--windows.rate", 5)
    assert "2 recorded rows become one" in text and "--option kind=delta" in text
    assert not (tmp_path / "store.work").exists()
    command(ingest, *line, "--windows.rate", 5, "--option", "kind=delta")
    assert "action 0  action[0] (delta) " in command(inspect, tmp_path / "store")
    command(ingest, *line, "--windows.rate", 0)
    assert "action 1  action[1] (undeclared) " in command(inspect, tmp_path / "store")


def test_a_store_is_split_and_merged(command: Command, tmp_path: Path) -> None:
    clip_store(tmp_path / "a")
    text = command(store, "split", tmp_path / "a", "--into", tmp_path / "parts", "--by", "difficulty")
    assert text.splitlines()[0] == f"{tmp_path}/parts/simple: train 3, test 1"
    command(store, "merge", tmp_path / "b", tmp_path / "parts" / "simple", tmp_path / "parts" / "difficult")
    shutil.move(tmp_path / "b", tmp_path / "c")
    assert sorted(numbers(open_store(tmp_path / "c"))) == list(range(6))
    command(store, "split", tmp_path / "c", "--into", tmp_path / "halves", "--parts", 2)
    assert len(numbers(open_store(tmp_path / "halves" / "part-001"))) == 3


def test_without_the_viewer_both_of_its_options_are_named(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    clip_store(tmp_path / "a")
    for option in ("--rerun", "--rerun-file=a.rrd"):
        text = command.refused(inspect, tmp_path / "a", option)
        assert "--rerun and --rerun-file need the viewer: pip install 'rsjax[rerun]'" in text


def test_a_damaged_store_is_inspected_and_the_status_says_so(command: Command, tmp_path: Path) -> None:
    clip_store(tmp_path / "a", size=32)
    shard = tmp_path / "a" / "test-00000.array_record"
    payload = np.fromfile(shard, np.uint8)
    payload[len(payload) // 2 :] = 0
    payload.tofile(shard)
    command.finding(inspect, tmp_path / "a")


@pytest.mark.parametrize(
    ("module", "arguments", "match"),
    [
        (ingest, [], "name a source and its path first"),
        (ingest, ["rlsd", "."], "did you mean 'rlds'"),
        (ingest, ["folder", "nowhere"], "nowhere: not there"),
        (ingest, ["folder", ".", "--option", "fps"], "--option 'fps': write NAME=VALUE"),
        (ingest, ["folder", ".", "--option", "fsp=5"], "no option 'fsp'; did you mean 'fps'"),
        (ingest, ["folder", ".", "--difficulty", "simple"], "--difficulty 'simple': write PATTERN=WORD"),
        (ingest, ["folder", ".", "--tracks", "magic"], "tracks: no method 'magic'"),
        (ingest, ["folder", ".", "--test-share", "1"], "--test-share is 1.0"),
        (ingest, ["folder", ".", "--workers", "-7"], "--workers is -7"),
        (ingest, ["folder", ".", "--runner", "ray", "--workers", "-7"], "--workers is -7"),
        (ingest, ["folder", ".", "--gpus", "0.5"], "--gpus is for Ray alone; add --runner ray"),
        (ingest, ["folder", ".", "--runner", "ray", "--cpus", "0"], "--cpus is 0.0"),
        (ingest, ["folder", ".", "--out", "/"], "--out is /; name a directory"),
        (ingest, ["folder", ".", "--depth", "recorded:most_holes=2"], "most_holes is 2.0"),
        (ingest, ["folder", ".", "--selection", "no.json"], "no.json: not there; make it with rsjax doctor"),
        (ingest, ["folder", ".", "--windows.frames", "1"], "windows.frames is 1"),
        (ingest, ["folder", ".", "--image-size", "1000000"], "--image-size is 1000000"),
        (ingest, ["folder", ".", "--points", "0"], "--points is 0"),
        (inspect, [], "missing STORE"),
        (inspect, ["nowhere", "--sheet", "sheet.xyz"], "name a .png"),
        (inspect, ["nowhere"], "nowhere: not there; give a store"),
        (inspect, ["nowhere", "--records", "-1"], "inspect.records is -1; it must be at least 1"),
        (ingest, ["sim", "tests"], "tests: no store (it has no manifest.json); give a store, or make one"),
        (doctor, [], "usage: rsjax doctor STORE, or rsjax doctor SOURCE PATH"),
        (doctor, ["rlsd"], "rlsd: no store"),
        (doctor, ["rlds"], "rlds is a format; say where"),
        (doctor, ["rlds", ".", "--lines", "-1"], "--lines is -1; it is 0 or more"),
        (store, [], "usage"),
        (store, ["merge", "a", "b"], "merging takes two stores or more"),
        (store, ["split", "--by", "task"], "missing STORE"),
    ],
)
def test_what_cannot_be_done_is_one_line(
    command: Command, module: ModuleType, arguments: list[str], match: str
) -> None:
    assert match in command.refused(module, *arguments)


def test_source_options_are_json_where_they_can_be() -> None:
    settings = source_options(("fps=5", "held=[6]", "keys=bridge", "task=a=b"))
    assert settings == {"fps": 5, "held": [6], "keys": "bridge", "task": "a=b"}
    json.dumps(settings)
