"""Tests that the core imports no tool, and that no module imports itself through others."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
TOOLS = ("rsjax.tools", "experiments", "benchmarks", "tests")


def modules() -> dict[str, Path]:
    paths = {path: ".".join(path.relative_to(ROOT).with_suffix("").parts) for path in (ROOT / "rsjax").rglob("*.py")}
    return {name.removesuffix(".__init__"): path for path, name in paths.items()}


def imported(path: Path) -> set[str]:
    """Returns the modules that a file imports anywhere in its code, and the names that it imports from them."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


def test_no_module_imports_itself_through_others() -> None:
    known = modules()
    edges = {name: (imported(path) & known.keys()) - {name} for name, path in known.items() if name != "rsjax"}
    for name, path in known.items():
        parents = {name.rpartition(".")[0]} if path.name != "__init__.py" else set()
        edges[name] = edges.get(name, set()) - parents
    tuple(TopologicalSorter(edges).static_order())  # raises CycleError, which names the cycle, if there is one


def test_the_core_imports_no_tool() -> None:
    core = {name: path for name, path in modules().items() if not name.startswith("rsjax.tools")}
    wrong = [
        f"{name} imports {target}"
        for name, path in core.items()
        for target in sorted(imported(path))
        if target.startswith(TOOLS)
    ]
    assert not wrong
