"""Runs the cells of the notebooks in examples/, in one process and without Jupyter."""

import json
import shlex
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from rsjax.tools.commands.main import main

FOLDER = Path(__file__).parents[1] / "examples"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))

pytestmark = pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive")


def cells(name: str, kind: str = "code") -> list[dict[str, Any]]:
    notebook = json.loads((FOLDER / name).read_text())
    return [cell for cell in notebook["cells"] if cell["cell_type"] == kind]


def run(name: str, steps: int = 0) -> dict[str, Any]:
    """Runs a notebook's cells and returns their variables; a line ``!rsjax …`` calls the command in this process.

    Args:
        steps: of every training, in place of the notebook's own number; 0: as many as there.
    """
    variables: dict[str, Any] = {}

    def command(line: str) -> None:
        _, *words = shlex.split(line.format(**variables))
        if steps and "--steps" in words:
            words[words.index("--steps") + 1] = str(steps)
        with patch.object(sys, "argv", ["rsjax", *words]):
            main()

    variables["command"] = command
    for number, cell in enumerate(cells(name)):
        lines = "".join(cell["source"]).replace("\\\n", " ").splitlines()
        code = [f"command({line[1:]!r})" if line.startswith("!rsjax ") else line for line in lines]
        exec(compile("\n".join(code), f"{name}, code cell {number}", "exec"), variables)
    return variables


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Has figures drawn without a screen, files written elsewhere, and no command restart the process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.hugetlb=1")


def test_generate_and_look() -> None:
    made = run("1_generate_and_look.ipynb")
    psnr = made["psnr"]
    later = made["truth"][:, 1:]
    still = psnr(later, made["truth"][:, :1]).mean()
    assert psnr(later, made["videos"].rgb[:, 1:]).mean() > still + 3
    assert made["futures"].rgb.shape == (3, 16, 64, 64, 3)


def test_bring_your_own_data(tmp_path: Path) -> None:
    made = run("2_bring_your_own_data.ipynb", steps=4)
    assert made["store"].counts() == {"train": 12, "test": 4}
    assert (tmp_path / "runs" / "mine" / "report.html").exists()
    scores = {name: made["psnr"](made["truth"], frames)[:, 1:].mean() for name, frames in made["predictions"].items()}
    assert scores["tiny"] > scores["first picture repeated"]
    assert np.isfinite(scores["runs/mine"])


def test_a_policy_in_the_dream() -> None:
    made = run("3_a_policy_in_the_dream.ipynb")
    counts = {name: succeeded.sum() for name, (_, succeeded, _) in made["results"].items()}
    assert counts["replay"] > counts["random"]
    assert (made["verdicts"] == made["truth"]).mean() > 0.9


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks_are_committed_without_outputs_and_explain_every_cell(path: Path) -> None:
    notebook = json.loads(path.read_text())
    assert (notebook["nbformat"], notebook["cells"][0]["cell_type"]) == (4, "markdown")
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells(path.name))
    kinds = [cell["cell_type"] for cell in notebook["cells"]]
    assert ("code", "code") not in pairwise(kinds)
    assert path.stat().st_size < 100_000
