"""The table of hostile inputs: it covers every command, its verdicts are right, and a few of its cases end well."""

import json
import random
from pathlib import Path

import pytest

from benchmarks.hostile.__main__ import summary
from benchmarks.hostile.cases import BAD, GOOD, Case, Ended, Place, command, verdict
from benchmarks.hostile.kills import differences, unlabel
from benchmarks.hostile.options import LINES
from benchmarks.hostile.table import all_cases
from rsjax.runtime import HUGE_PAGES
from rsjax.tools.commands.main import COMMANDS

CASES = list(all_cases())


def test_the_table_covers_every_command_and_has_each_name_once() -> None:
    commands = {name for group in COMMANDS.values() for name in group}
    assert {line.split()[0] for line in LINES.values()} == commands | {"softness"}
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names) >= 1500


def sample() -> list[Case]:
    """Cases that a command refuses before it opens anything."""
    fast = [case for case in CASES if case.name.startswith("options: ") and case.name.endswith(("'nan'", "'x'", "'²'"))]
    return random.Random(0).sample([case for case in fast if not case.accepted], 6)


@pytest.mark.parametrize("case", sample(), ids=lambda case: case.name)
def test_a_few_cases_end_well(case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GLIBC_TUNABLES", HUGE_PAGES)  # otherwise the process would restart itself
    ended = case.act(Place(tmp_path, tmp_path))
    assert verdict(case, ended) in GOOD, ended


def test_a_study_is_called_as_commands_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GLIBC_TUNABLES", HUGE_PAGES)
    ended = command(["softness", "tiny", "--data-dir", "/proc/full"], Place(tmp_path, tmp_path))
    assert ended.kind == "refused"
    assert "--episodes is 300, which takes more than" in ended.text


def test_a_verdict_follows_from_how_a_case_ends() -> None:
    def act(place: Place) -> Ended:
        raise NotImplementedError

    case = Case("x", act, names=("--port",))
    ends = {
        Ended("refused", "error: --port is -1; it is from 0 to 65535"): "clear line",
        Ended("refused", "error: something is wrong"): "unclear line",
        Ended("refused", "error: --port\nand more"): "unclear line",
        Ended("broke", "Traceback …"): "traceback",
        Ended("unclear", "exit status 1"): "unclear line",
        Ended("ended"): "harmless",
        Ended("began", "fit"): "accepted",
    }
    for ended, expected in ends.items():
        assert verdict(case, ended) == expected
        assert expected in (*GOOD, *BAD)
    documented = Case("x", act, accepted="0 is all of them")
    assert verdict(documented, Ended("began", "fit")) == "documented"


def test_the_summary_counts_and_lists_bad_cases() -> None:
    results = {
        "options: a": {"verdict": "clear line", "text": ""},
        "options: b": {"verdict": "hang", "text": "not over after 60 s"},
        "files: c": {"verdict": "clear line", "text": ""},
    }
    text = summary(results, "python -m benchmarks.hostile")
    assert "| options | 1 | 1 | 2 |" in text
    assert "| all | 2 | 1 | 3 |" in text
    assert "- hang: options: b\n  not over after 60 s" in text


def test_directories_are_compared_without_measured_times(tmp_path: Path) -> None:
    for name, seconds, text in (("one", 1.0, "a"), ("two", 2.0, "a"), ("three", 1.0, "b")):
        (tmp_path / name / "inner").mkdir(parents=True)
        (tmp_path / name / "inner" / "result.json").write_text(f'{{"rows": [{{"seconds": {seconds}}}], "psnr": 20.0}}')
        (tmp_path / name / "inner" / "text.md").write_text(text)
        (tmp_path / name / ".lock").write_text(name)
    assert list(differences(tmp_path / "one", tmp_path / "two")) == []
    assert list(differences(tmp_path / "one", tmp_path / "three")) == ["inner/text.md differs"]


def test_demonstrations_without_labels_are_a_copy_that_says_nothing_of_success(tmp_path: Path) -> None:
    manifest = tmp_path / "data" / "lift" / "manifest.json"
    manifest.parent.mkdir(parents=True)
    manifest.write_text('{"key": "a", "success_share": 0.0}')
    for _ in range(2):
        unlabel(tmp_path)
        copied = json.loads((tmp_path / "unlabelled" / "lift" / "manifest.json").read_text())
        assert copied == {"key": "a", "success_share": None}
    assert json.loads(manifest.read_text())["success_share"] == 0.0
