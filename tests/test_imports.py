"""Tests that imports point one way along the package's folders, and that no module imports itself through others."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
# A folder or module imports only from itself and from those before it in this list.
ORDER = [
    "errors",
    "progress",
    "files",
    "runtime",
    "processes",
    "command",
    "config",
    "clip",
    "devices",
    "data",
    "export",
    "sim",
    "ingest",
    "trainable",
    "matmul",
    "group_norm",
    "tokenizers",
    "models",
    "training",
    "evaluation",
    "report",
    "pipeline",
    "policies",
    "play",
    "ablation",
    "compare",
    "bench",
    "paper",
    "describe",
    "convert",
]


def modules() -> dict[str, Path]:
    paths = {path: ".".join(path.relative_to(ROOT).with_suffix("").parts) for path in (ROOT / "rsjax").rglob("*.py")}
    return {name.removesuffix(".__init__"): path for path, name in paths.items()}


def imported(path: Path, known: dict[str, Path]) -> set[str]:
    """Returns the package's modules that a file imports anywhere in its code."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            each = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in known else node.module for name in each}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names & known.keys()


def test_imports_point_one_way_and_never_round() -> None:
    known = modules()
    edges = {name: imported(path, known) - {name} for name, path in known.items() if name != "rsjax"}
    tuple(TopologicalSorter(edges).static_order())  # raises CycleError, which names the cycle, if there is one
    wrong = []
    for name, targets in edges.items():
        for target in targets:
            here, there = (part.split(".")[1] if "." in part else "" for part in (name, target))
            if here != there and there and ORDER.index(there) > ORDER.index(here):
                wrong.append(f"{name} imports {target}")
    assert not wrong
