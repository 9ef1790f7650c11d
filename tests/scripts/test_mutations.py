"""Every mutation can be tried, and its verdict is that of the tests."""

from pathlib import Path

import pytest

from scripts.mutations import MUTATIONS, ROOT, Mutation, anchors, try_mutation


@pytest.mark.parametrize("mutation", MUTATIONS, ids=[each.name for each in MUTATIONS])
def test_its_line_stands_once_and_its_tests_exist(mutation: Mutation) -> None:
    assert len(anchors(mutation, ROOT)) == 1
    assert any(list((ROOT / "tests").rglob(name)) for name in mutation.tests)
    assert mutation.right != mutation.wrong


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A package with a function and its test."""
    (tmp_path / "rsjax").mkdir()
    (tmp_path / "tests").mkdir()
    (tmp_path / "rsjax" / "sums.py").write_text("def add(a, b):\n    c = 0\n    return a + b + c\n")
    (tmp_path / "tests" / "test_sums.py").write_text(
        "from rsjax.sums import add\n\ndef test_it():\n    assert add(1, 2) == 3\n"
    )
    return tmp_path


@pytest.mark.parametrize(
    ("right", "wrong", "test", "verdict"),
    [
        ("a + b", "a - b", "test_sums.py", "killed"),
        ("a + b", "b + a", "test_sums.py", "survived"),
        ("a * b", "a - b", "test_sums.py", "no anchor"),
        ("a + b", "a - b", "test_others.py", "no test"),
    ],
)
def test_verdicts(right: str, wrong: str, test: str, verdict: str, tree: Path) -> None:
    assert try_mutation(Mutation("add", right, wrong, (test,)), tree) == verdict
    assert "a + b" in (tree / "rsjax" / "sums.py").read_text()
