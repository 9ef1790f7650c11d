"""Tests that the core imports no tool, and that no module imports itself through others."""

import ast
from collections.abc import Collection
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
TOOLS = ("rsjax.tools", "experiments", "benchmarks", "tests")


def modules() -> dict[str, Path]:
    paths = {path: ".".join(path.relative_to(ROOT).with_suffix("").parts) for path in (ROOT / "rsjax").rglob("*.py")}
    return {name.removesuffix(".__init__"): path for path, name in paths.items()}


def imported(path: Path, known: Collection[str]) -> set[str]:
    """Returns the modules that a file imports anywhere in its code; ``known`` tells modules from other names."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            each = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in known else node.module for name in each}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


def test_no_module_imports_itself_through_others() -> None:
    known = modules()
    edges = {name: (imported(path, known) & known.keys()) - {name} for name, path in known.items() if name != "rsjax"}
    tuple(TopologicalSorter(edges).static_order())  # raises CycleError, which names the cycle, if there is one


def test_the_core_imports_no_tool() -> None:
    known = modules()
    core = {name: path for name, path in known.items() if not name.startswith("rsjax.tools")}
    wrong = [
        f"{name} imports {target}"
        for name, path in core.items()
        for target in sorted(imported(path, known))
        if target.startswith(TOOLS)
    ]
    assert not wrong


def test_tokenizers_import_no_model() -> None:
    known = modules()
    tokenizers = {name: path for name, path in known.items() if name.startswith("rsjax.tokenizers")}
    assert not [name for name, path in tokenizers.items() if any("models" in one for one in imported(path, known))]


def family_of(module: str) -> str:
    """Returns the family of world models that a module belongs to; "" if it belongs to none."""
    parts = module.split(".")
    is_family = (
        parts[:2] == ["rsjax", "models"] and len(parts) > 2 and (ROOT.joinpath(*parts[:3]) / "model.py").exists()
    )
    return parts[2] if is_family else ""


def test_no_family_of_models_imports_another() -> None:
    """What families share is in ``models/diffusion``; only Genie is a special case of another, RoboScape."""
    known = modules()
    pairs = {(family_of(name), family_of(target)) for name, path in known.items() for target in imported(path, known)}
    assert ("roboscape", "roboscape") in pairs
    assert {(own, other) for own, other in pairs if own and other and own != other} == {("genie", "roboscape")}


def test_an_installation_holds_every_module() -> None:
    """Setuptools leaves out a folder without ``__init__.py``, with all folders in it."""
    folders = {path.parent for path in (ROOT / "rsjax").rglob("*.py")}
    assert not [str(folder.relative_to(ROOT)) for folder in folders if not (folder / "__init__.py").exists()]
