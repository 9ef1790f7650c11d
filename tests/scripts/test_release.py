"""Versions agree wherever they stand, and the script that sets them sets all of them."""

import shutil
import subprocess
from configparser import ConfigParser
from pathlib import Path

import pytest

import rsjax
from scripts import release

FILES = (release.PACKAGE, release.CITATION, release.CHANGELOG)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """The three files with a version, in a repository of their own."""
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(release.ROOT / name, tmp_path / name)
    return tmp_path


def test_changelog_citation_and_package_have_one_version() -> None:
    settings = ConfigParser()
    settings.read(release.ROOT / "setup.cfg")
    assert settings["metadata"]["version"] in (rsjax.__version__, "attr: rsjax.__version__")
    assert release.version(release.ROOT) == rsjax.__version__
    assert release.cited_version(release.ROOT) == rsjax.__version__
    assert release.noted_versions(release.ROOT)[0] == rsjax.__version__


def test_a_release_is_dated_and_the_next_one_begun(tree: Path) -> None:
    own = release.version(tree)
    if release.UNRELEASED in (tree / release.CHANGELOG).read_text():
        with pytest.raises(SystemExit) as early:
            release.begin(tree, "99.0.0")
        assert "is not released yet" in str(early.value)
        release.date(tree, "2030-01-02")
        assert f"## {own} – 2030-01-02" in (tree / release.CHANGELOG).read_text()
        assert f"version: {own}\ndate-released: 2030-01-02" in (tree / release.CITATION).read_text()
    release.begin(tree, "99.0.0")
    assert release.version(tree) == release.cited_version(tree) == release.noted_versions(tree)[0] == "99.0.0"
    assert "date-released" not in (tree / release.CITATION).read_text()
    assert release.notes(tree, own) == release.notes(release.ROOT, own) and release.notes(tree, "99.0.0") == ""


@pytest.mark.parametrize("wrong", ["0.0.1", "1", "1.0", "1.0.0rc1"])
def test_a_version_that_cannot_be_next_is_refused(tree: Path, wrong: str) -> None:
    with pytest.raises(SystemExit) as error:
        release.begin(tree, wrong)
    assert "three numbers" in str(error.value)


def test_a_wheel_that_was_built_is_no_change(tree: Path) -> None:
    shutil.copy(release.ROOT / ".gitignore", tree)
    subprocess.run(["git", "init", "-q"], cwd=tree, check=True)
    (tree / "dist").mkdir()
    (tree / "dist" / "rsjax.whl").touch()
    status = subprocess.run(["git", "status", "--porcelain"], cwd=tree, check=True, capture_output=True, text=True)
    assert "dist" not in status.stdout


def test_uncommitted_changes_stop_a_release(tree: Path) -> None:
    subprocess.run(["git", "init", "-q"], cwd=tree, check=True)
    with pytest.raises(SystemExit) as error:
        release.release(tree)
    assert "commit or stash" in str(error.value)
