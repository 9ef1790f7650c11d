"""Pages whose tables are generated from files of results."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from rsjax.errors import UserError
from rsjax.evaluation.statistics import wilson
from rsjax.tools.studies.result_pages import DATA, FOLDER, add_runs, differences, part_of, write_pages
from rsjax.tools.studies.run_results import run_tables
from tests.tools.pipeline.conftest import command, debug, printed_by, shared

__all__ = ["command", "debug", "shared"]  # fixtures
PAGE = """# A page

<!-- table one arms -->
<!-- end -->

Text between tables.

<!-- table one comparisons -->
<!-- end -->
"""


def comparison(difference: str, interval: str, p: str, name: str = "", metric: str = "PSNR") -> list[str]:
    return [name, metric, difference, interval, p, "as printed"]


def file(rows: list[list[str]], **judge: Any) -> dict[str, Any]:
    head = ["compared", "by", "difference", "95 % interval", "p", "verdict"]
    comparisons = {"judge": {"lower": ["MSE"], "family": "table"} | judge, "head": head, "rows": rows}
    arms = {"head": ["", "PSNR"], "rows": [["*one*", "20.1 ± 0.2"], ["two | three", ""]]}
    return {"kind": "transcribed", "tables": {"arms": arms, "comparisons": comparisons}}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A repository with a page of two tables and their file."""
    (tmp_path / DATA).mkdir(parents=True)
    (tmp_path / "README.md").write_text("| a table | of no result |\n")
    (tmp_path / FOLDER / "page.md").write_text(PAGE)
    content = file([comparison("+0.50", "0.20 … 0.80", "0.004", "a − b")])
    (tmp_path / DATA / "one.json").write_text(json.dumps(content))
    return tmp_path


def verdicts(root: Path, rows: list[list[str]], **judge: Any) -> list[str]:
    (root / DATA / "one.json").write_text(json.dumps(file(rows, **judge)))
    lines = part_of(root, "one", "comparisons").splitlines()
    return [line.split(" | ")[-1].removesuffix(" |") for line in lines[2:]]


def test_the_tables_of_this_repository_are_those_of_its_files() -> None:
    printed_by("experiments.results", "--check")


def test_a_changed_table_is_named_with_its_page_and_made_anew(root: Path) -> None:
    page = root / FOLDER / "page.md"
    assert len(list(differences(root))) == 2
    assert write_pages(root) == [page] and write_pages(root) == []
    assert list(differences(root)) == []
    text = page.read_text()
    assert "| *one* | 20.1 ± 0.2 |\n| two \\| three | |\n<!-- end -->" in text and "Text between tables." in text
    page.write_text(text.replace("20.1", "20.2"))
    assert list(differences(root)) == [f"{FOLDER}/page.md: table one arms differs from {DATA}/one.json"]
    write_pages(root)
    assert page.read_text() == text


def test_a_run_becomes_a_file_and_the_table_of_its_scores(root: Path, debug: Path) -> None:
    add_runs(root, [debug], "tiny")
    metrics = json.loads((debug / "metrics.json").read_text())
    lines = part_of(root, "tiny", "scores").splitlines()
    prediction, repeated, reconstruction, truth = (line.split(" | ") for line in lines[2:6])
    assert lines[0].split(" | ")[1:3] == ["PSNR, dB ↑", "PSNR where it moves, dB ↑"]
    assert prediction[1] == f"{metrics['psnr']:.2f}" and repeated[1] == f"{metrics['psnr_repeat_first']:.2f}"
    assert reconstruction[1] == f"{metrics['psnr_tokenizer']:.2f}" and truth[1] == "|"  # an empty cell
    right = round(2 * metrics["lifted_accuracy"])
    interval = wilson(right, 2)
    assert prediction[-1] == f"{right / 2:.0%} ({interval.low:.0%} … {interval.high:.0%}) |".replace("%", " %")
    assert lines[-1].startswith("Preset `debug`, 1 run (seed 0), 2 held-out clips; commit ")
    head, _, shorter, *_ = (line.split(" | ") for line in part_of(root, "tiny", "headline").splitlines())
    assert head[:4] == lines[0].split(" | ")[:4] and shorter[:4] == prediction[:4]
    assert len(head) == len(shorter) == 5 and shorter[4].removesuffix(" |") == f"{metrics['depth_absrel']:.4f}"


def test_runs_on_the_same_clips_do_not_narrow_the_interval_of_a_share(root: Path, debug: Path) -> None:
    add_runs(root, [debug], "tiny")
    content = json.loads((root / DATA / "tiny.json").read_text())
    (run,) = content["runs"]
    moved = run | {"clips": run["clips"] | {"psnr_repeat_first": [0.0, 1.0]}}
    cells = [run_tables(content | {"runs": runs})["scores"].rows[0][-1] for runs in ([run], [run, run], [run, moved])]
    assert cells[0] == cells[1] != cells[2]


def test_the_runs_of_a_file_are_finished(root: Path, debug: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(debug, other)
    config = json.loads((other / "config.json").read_text())
    config["train"]["seed"] = 1
    (other / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError) as error:
        add_runs(root, [debug, other], "tiny")
    assert str(error.value).startswith(f"{other}: not a finished run")
    assert not (root / DATA / "tiny.json").exists()


def test_a_table_without_a_file_is_named(root: Path) -> None:
    write_pages(root)
    (root / FOLDER / "other.md").write_text("| psnr |\n|---|\n| 20 |\n")
    (line,) = differences(root)
    assert line.startswith(f"{FOLDER}/other.md: a table outside the marks")


def test_a_name_or_a_part_that_does_not_exist_is_one_line(root: Path) -> None:
    (root / FOLDER / "page.md").write_text(PAGE.replace("one arms", "one arm"))
    with pytest.raises(UserError) as error:
        write_pages(root)
    assert str(error.value).startswith(f"{FOLDER}/page.md: {DATA}/one.json has no part arm; did you mean 'arms'?")
    with pytest.raises(UserError) as error:
        part_of(root, "two", "arms")
    assert str(error.value) == f"{DATA} has no two.json"


def test_a_transcribed_verdict_needs_the_interval_and_holms_p(root: Path) -> None:
    rows = [
        comparison("+0.5", "0.2 … 0.8", "0.02", "a − b"),
        comparison("+0.5", "0.2 … 0.8", "0.03"),
        comparison("+0.5", "-0.1 … 1.1", "< 0.001"),
        comparison("-0.5", "-0.8 … -0.2", "0.001", metric="MSE"),
        comparison("-0.5", "-0.8 … -0.2", "0.001"),
    ]
    assert verdicts(root, rows) == ["holds", "holds", "cannot tell", "holds", "does not hold"]
    assert verdicts(root, rows[:2], further=[0.01]) == ["holds", "holds"]
    assert verdicts(root, rows[:2], further=[0.04]) == ["cannot tell", "cannot tell"]  # 3 × 0.02


def test_a_group_is_a_claim_of_its_own(root: Path) -> None:
    rows = [comparison("+0.5", "0.2 … 0.8", "0.03", "a − b"), comparison("+0.5", "0.2 … 0.8", "0.04", "a − c")]
    assert verdicts(root, rows) == ["cannot tell", "cannot tell"]
    assert verdicts(root, rows, family="group") == ["holds", "holds"]
