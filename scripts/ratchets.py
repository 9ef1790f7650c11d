"""Counts what may only fall, and compares it with ``scripts/ratchets.json``.

``python -m scripts.ratchets`` prints a table and exits with 1 if a number has risen; ``--write`` lowers the committed
numbers to those of today. There is no ceiling on a file's or a function's length.
"""

import ast
import json
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
COMMITTED = Path(__file__).with_suffix(".json")
PACKAGES = ("rsjax", "experiments")
TOOLS = ("rsjax.tools", "experiments", "benchmarks", "tests")

Functions = ast.FunctionDef | ast.AsyncFunctionDef


def main() -> None:
    """Compares today's numbers with the committed ones, or lowers those."""
    now = count(ROOT)
    if "--write" in sys.argv[1:]:
        write(now, COMMITTED)
    committed = json.loads(COMMITTED.read_text())
    for name, value in now.items():
        print(f"{name:<44} {value:>6} (at most {committed[name]})")
    if problems := risen(now, committed):
        raise SystemExit("\n".join(problems))


def write(now: dict[str, float], path: Path) -> None:
    """Lowers the committed numbers to today's; one that has risen stays as it was."""
    committed = json.loads(path.read_text()) if path.exists() else {}
    lowered = {name: min(value, committed.get(name, value)) for name, value in now.items()}
    path.write_text(json.dumps(lowered, indent=2) + "\n")


def risen(now: dict[str, float], committed: dict[str, float]) -> list[str]:
    """Returns a line for each number that is higher than the committed one."""
    return [
        f"{name} rose from {committed[name]} to {value}; see scripts/README.md"
        for name, value in now.items()
        if value > committed[name]
    ]


def count(root: Path) -> dict[str, float]:
    """Returns today's numbers by name."""
    sources = {path: path.read_text() for package in PACKAGES for path in sorted((root / package).rglob("*.py"))}
    trees = {path: ast.parse(source) for path, source in sources.items()}
    nodes = [node for tree in trees.values() for node in ast.walk(tree)]
    tests = [node for path in sorted((root / "tests").rglob("*.py")) for node in ast.walk(ast.parse(path.read_text()))]
    lines = sum(1 for source in sources.values() for line in source.splitlines() if line.strip())
    private = [uses for tree in trees.values() for uses in private_functions(tree).values()]
    imports = sum(node.end_lineno - node.lineno + 1 for node in nodes if is_import(node))  # type: ignore[attr-defined]
    core = [tree for path, tree in trees.items() if is_core(path.relative_to(root))]
    return {
        "tuple assignments per 1000 lines": round(1000 * sum(map(is_tuple_assignment, nodes)) / lines, 1),
        "ternaries per 1000 lines": round(1000 * sum(isinstance(node, ast.IfExp) for node in nodes) / lines, 1),
        "percent of private functions called once": round(100 * private.count(1) / max(1, len(private)), 1),
        "percent of lines that are imports": round(100 * imports / lines, 1),
        "imports of tools by the core": sum(imports_a_tool(node) for tree in core for node in ast.walk(tree)),
        "fields of the preset tiny": fields_of_tiny(),
        "names patched in tests": sum(map(patches, tests)),
        "private names patched in tests": sum(map(patches_private_name, tests)),
        "messages matched in tests": sum(matches_message(node) for node in tests),
    }


def is_core(path: Path) -> bool:
    """Whether a file belongs to the core: what lies in ``rsjax`` outside ``rsjax/tools``."""
    return path.parts[0] == "rsjax" and path.parts[1] != "tools"


def is_import(node: ast.AST) -> bool:
    """Whether this is an import, wherever it stands."""
    return isinstance(node, ast.Import | ast.ImportFrom)


def imports_a_tool(node: ast.AST) -> bool:
    """Whether this imports a tool, a command, a benchmark or a test."""
    if isinstance(node, ast.ImportFrom):
        module = node.module or ""
        names = [module, *(f"{module}.{alias.name}" for alias in node.names)]
    elif isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    else:
        return False
    return any(name == tool or name.startswith(f"{tool}.") for name in names for tool in TOOLS)


def is_tuple_assignment(node: ast.AST) -> bool:
    """Whether this is ``a, b = x, y``; unpacking the result of a call is not."""
    return isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple) and isinstance(node.targets[0], ast.Tuple)


def private_functions(tree: ast.Module) -> dict[str, int]:
    """Returns how often each private function or method of a file is named in that file."""
    used = Counter(
        node.id if isinstance(node, ast.Name) else node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Name | ast.Attribute)
    )
    return {name: used[name] for name in function_names(tree) if name.startswith("_") and not name.startswith("__")}


def function_names(tree: ast.Module) -> Iterator[str]:
    """Yields the names of a file's functions and methods, without those inside functions."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            yield from (inner.name for inner in node.body if isinstance(inner, Functions))
        elif isinstance(node, Functions):
            yield node.name


def patches(node: ast.AST) -> bool:
    """Whether this is a ``setattr`` of pytest's monkeypatch."""
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "setattr"


def patches_private_name(node: ast.AST) -> bool:
    """Whether this is a ``setattr`` of pytest's monkeypatch on a name that begins with an underscore."""
    if not patches(node):
        return False
    names = [argument.value for argument in node.args[:2] if isinstance(argument, ast.Constant)]  # type: ignore[attr-defined]
    return any(isinstance(name, str) and name.rpartition(".")[2].startswith("_") for name in names)


def matches_message(node: ast.AST) -> bool:
    """Whether this is a ``pytest.raises(…, match=…)``."""
    return isinstance(node, ast.Call) and any(keyword.arg == "match" for keyword in node.keywords)


def fields_of_tiny() -> int:
    """Returns the number of settings of the main preset, without sections that are off in it."""
    from rsjax.config import presets
    from rsjax.config.config_fields import config_fields

    return sum(field.value != "off" for field in config_fields(presets.get("tiny")).values())


if __name__ == "__main__":
    main()
