"""The numbers of scripts/ratchets.json have not risen, and each is counted as its name says."""

import ast
import json
from pathlib import Path

import pytest

from scripts import ratchets


def test_no_number_has_risen() -> None:
    assert ratchets.risen(ratchets.count(ratchets.ROOT), json.loads(ratchets.COMMITTED.read_text())) == []


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Two files of nine lines that are not blank, and a test."""
    core = ("import os", "from rsjax.tools import sim", "", "a, b = 1, 2", "c, d = divmod(7, 2)", "e = 1 if a else 2")
    tool = ("import os", "def _once(): pass", "def _twice(): _once(); _twice()", "_twice()")
    tests = ("patch.setattr(core, '_a', 1)", "patch.setattr('core.b', 1)", "raises(E, match='no')")
    files = {"rsjax/core.py": core, "rsjax/tools/tool.py": tool, "tests/test_core.py": tests}
    for name, lines in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("\n".join(lines))
    return tmp_path


def test_each_number_is_counted(tree: Path) -> None:
    assert ratchets.count(tree) == {
        "tuple assignments per 1000 lines": round(1000 / 9, 1),
        "ternaries per 1000 lines": round(1000 / 9, 1),
        "percent of private functions called once": 50.0,
        "percent of lines that are imports": round(100 * 3 / 9, 1),
        "imports of tools by the core": 1,
        "fields of the preset tiny": ratchets.fields_of_tiny(),
        "names patched in tests": 2,
        "private names patched in tests": 1,
        "messages matched in tests": 1,
    }


def test_a_higher_number_is_named_and_a_lower_one_passes() -> None:
    assert ratchets.risen({"a": 1.0, "b": 3.0}, {"a": 2.0, "b": 2.0}) == [
        "b rose from 2.0 to 3.0; see scripts/README.md"
    ]


def test_writing_only_lowers(tmp_path: Path) -> None:
    committed = tmp_path / "ratchets.json"
    committed.write_text(json.dumps({"a": 2.0, "b": 2.0}))
    ratchets.write({"a": 1.0, "b": 3.0, "new": 4.0}, committed)
    assert json.loads(committed.read_text()) == {"a": 1.0, "b": 2.0, "new": 4.0}


@pytest.mark.parametrize(
    "line", ["import rsjax.tools.sim", "from rsjax import tools", "from experiments.cli import parse"]
)
def test_every_way_to_import_a_tool_is_seen(line: str) -> None:
    assert ratchets.imports_a_tool(ast.parse(line).body[0])
    assert not ratchets.imports_a_tool(ast.parse("import rsjax.toolshed").body[0])
