"""Tests that the documentation's links lead somewhere, and that its pages stay short enough to be read."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PROJECT = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")]
PAGES = [*PROJECT, *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "notebooks").rglob("*.md"))]
USER_PAGES = sorted((ROOT / "docs").rglob("*.md"))
LONGEST = 200  # lines of a page for users
SHORTER = {"performance.md": 150}
FOLDER_README = 15  # lines of a folder's README
CODE = (".py", ".js")


def anchors(page: Path) -> set[str]:
    """Returns the anchors that GitHub makes from a page's headings."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").lower() for heading in headings]
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in plain}


def folder_readmes() -> list[Path]:
    """Returns the pages of all folders but the cards of models."""
    folders = ("rsjax", "examples", "experiments", "benchmarks", "launch", "notebooks", "scripts", "tests")
    paths = [path for folder in folders for path in sorted((ROOT / folder).rglob("README.md"))]
    return [path for path in paths if path.parents[1].name != "pretrained"]


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", [*PAGES, *folder_readmes()], ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if link.startswith(("http://", "https://")):
            continue
        target, _, anchor = link.partition("#")
        path = (page.parent / target).resolve() if target else page
        if not path.exists() or (anchor and path.suffix == ".md" and anchor not in anchors(path)):
            broken.append(link)
    assert not broken


@pytest.mark.parametrize("page", [ROOT / "README.md", *USER_PAGES], ids=name_of)
def test_names_that_a_page_imports_exist(page: Path) -> None:
    for module, names in re.findall(r"^from (rsjax[\w.]*) import ([\w, ]+)$", page.read_text(), re.MULTILINE):
        for name in names.split(", "):
            found = hasattr(importlib.import_module(module), name) or importlib.util.find_spec(f"{module}.{name}")
            assert found, f"{module} has no {name}"


def test_extras_are_installed_without_a_checkout() -> None:
    folders = [ROOT / name for name in ("rsjax", "benchmarks", "docs", "notebooks", "examples")]
    texts = [path for folder in folders for path in folder.rglob("*") if path.suffix in (".py", ".md", ".ipynb")]
    assert not [name_of(path) for path in [*PROJECT, *texts] if "pip install -e '.[" in path.read_text()]


def test_the_page_on_clusters_shows_how_arrays_are_split() -> None:
    code = re.search(r'python -c "\n(.*?)"\n', (ROOT / "docs" / "cluster.md").read_text(), re.DOTALL)
    assert code is not None
    done = subprocess.run([sys.executable, "-c", code[1]], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "params" in done.stdout


@pytest.mark.parametrize("page", USER_PAGES, ids=name_of)
def test_pages_for_users_are_short(page: Path) -> None:
    assert len(page.read_text().splitlines()) <= SHORTER.get(page.name, LONGEST)


def test_the_index_names_every_page() -> None:
    index = (ROOT / "docs" / "index.md").read_text()
    missing = [page.name for page in USER_PAGES if page.name != "index.md" and f"{page.name})" not in index]
    assert not missing


@pytest.mark.parametrize("readme", folder_readmes(), ids=name_of)
def test_readmes_of_folders_are_short(readme: Path) -> None:
    assert len(readme.read_text().splitlines()) <= FOLDER_README


def test_the_way_to_the_gradient_leads_through_files_that_have_what_it_names() -> None:
    page = (ROOT / "docs" / "code.md").read_text()
    rows = re.findall(r"^\| \d\. \[[\w/.]+\]\(\.\./(.+?)\) \| (.*) \|$", page, re.MULTILINE)
    assert len(rows) == 8
    for file, text in rows:
        code = (ROOT / file).read_text()
        assert not [name for name in re.findall(r"`(\w+)`", text) if name not in code], file


def test_every_folder_of_code_has_a_readme() -> None:
    files = [path for folder in ("rsjax", "benchmarks") for path in (ROOT / folder).rglob("*") if path.suffix in CODE]
    assert not sorted({name_of(path.parent) for path in files if not (path.parent / "README.md").exists()})


def pages_of(navigation: Any) -> list[str]:
    """Returns the pages that a navigation of MkDocs names."""
    if isinstance(navigation, str):
        return [navigation]
    parts = navigation.values() if isinstance(navigation, dict) else navigation
    return [page for part in parts for page in pages_of(part)]


def test_the_sites_navigation_names_every_page_once() -> None:
    settings = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    pages = [page for page in pages_of(settings["nav"]) if not page.startswith("project/")]
    assert sorted(pages) == sorted(page.relative_to(ROOT / "docs").as_posix() for page in USER_PAGES)
    assert settings["strict"] and "offline" in settings["plugins"]
    assert list(map(next, map(iter, settings["nav"]))) == [
        "Start here",
        "How-to",
        "Reference",
        "Explanation",
        "Lab results",
    ]
