"""Sets versions and dates of releases, in ``rsjax/__init__.py``, ``CITATION.cff`` and ``CHANGELOG.md``.

``python -m scripts.release`` releases the current version: it dates it, builds the wheel, commits and tags. ``--next
0.3.0`` begins the next version. ``--notes 0.2.0`` prints a version's notes, for the release page..
"""

import argparse
import datetime
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = "rsjax/__init__.py"
CITATION = "CITATION.cff"
CHANGELOG = "CHANGELOG.md"
UNRELEASED = "not released yet"
HEADING = re.compile(r"^## (\d+\.\d+\.\d+)(?: – (.*))?$", re.MULTILINE)


def main(argv: list[str]) -> None:
    """Runs what the arguments name."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument("--next", metavar="VERSION", help="begin this version instead of releasing")
    choice.add_argument("--notes", metavar="VERSION", help="print the notes of this version instead of releasing")
    options = parser.parse_args(argv)
    if options.notes:
        print(notes(ROOT, options.notes))
    elif options.next:
        begin(ROOT, options.next)
        print(f"{options.next} is begun; write its entries in {CHANGELOG}, then commit")
    else:
        release(ROOT)


def version(root: Path) -> str:
    """Returns the package's version, which ``setup.cfg`` takes from there."""
    found = re.search(r'^__version__ = "(.*)"$', (root / PACKAGE).read_text(), re.MULTILINE)
    if found is None:
        raise SystemExit(f"error: {PACKAGE} sets no __version__")
    return found[1]


def cited_version(root: Path) -> str:
    """Returns the version in ``CITATION.cff``."""
    found = re.search(r"^version: (.*)$", (root / CITATION).read_text(), re.MULTILINE)
    if found is None:
        raise SystemExit(f"error: {CITATION} names no version")
    return found[1]


def noted_versions(root: Path) -> list[str]:
    """Returns the versions in ``CHANGELOG.md``, the newest first."""
    return [found[1] for found in HEADING.finditer((root / CHANGELOG).read_text())]


def notes(root: Path, wanted: str) -> str:
    """Returns what ``CHANGELOG.md`` says of a version."""
    parts = HEADING.split((root / CHANGELOG).read_text())
    found = dict(zip(parts[1::3], parts[3::3], strict=True))
    if wanted not in found:
        raise SystemExit(f"error: {CHANGELOG} has no version {wanted} ({', '.join(found)})")
    return found[wanted].strip()


def begin(root: Path, new: str) -> None:
    """Sets the version to ``new`` in all three files."""
    if not re.fullmatch(r"\d+\.\d+\.\d+", new) or _numbers(new) <= _numbers(version(root)):
        raise SystemExit(f"error: {new} is no version after {version(root)}; it is three numbers, such as 0.3.0")
    changelog = (root / CHANGELOG).read_text()
    if UNRELEASED in changelog:
        raise SystemExit(f"error: {version(root)} is not released yet; python -m scripts.release does it")
    first = HEADING.search(changelog)
    assert first is not None
    section = f"## {new} – {UNRELEASED}\n\n"
    (root / CHANGELOG).write_text(changelog[: first.start()] + section + changelog[first.start() :])
    _replace(root / PACKAGE, r'^__version__ = ".*"$', f'__version__ = "{new}"')
    _replace(root / CITATION, r"^version: .*$", f"version: {new}")
    _replace(root / CITATION, r"^date-released: .*\n", "")


def date(root: Path, day: str) -> None:
    """Writes the day of the release of the current version into the changelog and the citation."""
    own = version(root)
    if not notes(root, own):
        raise SystemExit(f"error: {CHANGELOG} says nothing of {own}")
    _replace(root / CHANGELOG, rf"^## {re.escape(own)} – {UNRELEASED}$", f"## {own} – {day}")
    _replace(root / CITATION, rf"^version: {re.escape(own)}$", f"version: {own}\ndate-released: {day}")


def release(root: Path) -> None:
    """Dates the current version, builds its wheel, commits and tags."""
    own = version(root)
    if _git(root, "status", "--porcelain"):
        raise SystemExit("error: commit or stash your changes first")
    if f"v{own}" in _git(root, "tag").split():
        raise SystemExit(f"error: v{own} is tagged already; begin the next version with --next")
    if noted_versions(root)[0] != own or cited_version(root) != own:
        raise SystemExit(f"error: {CHANGELOG} or {CITATION} is not of {own}; tests/scripts/test_release.py says which")
    date(root, datetime.date.today().isoformat())
    subprocess.run([sys.executable, "-m", "pip", "wheel", "--no-deps", "-q", "-w", "dist", "."], cwd=root, check=True)
    _git(root, "commit", "-a", "-m", f"Release {own}")
    _git(root, "tag", "-a", f"v{own}", "-m", f"rsjax {own}")
    print(f"v{own} is tagged; dist/ has its wheel")
    print("next: git push --follow-tags (the workflow makes the release), then python -m scripts.release --next …")


def _numbers(text: str) -> list[int]:
    return [int(number) for number in text.split(".")]


def _replace(path: Path, pattern: str, text: str) -> None:
    path.write_text(re.sub(pattern, text, path.read_text(), count=1, flags=re.MULTILINE))


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", *words], cwd=root, check=True, capture_output=True, text=True)
    return done.stdout


if __name__ == "__main__":
    main(sys.argv[1:])
