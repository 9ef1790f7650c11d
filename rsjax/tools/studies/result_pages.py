"""Pages whose tables are generated from files of results.

A page has a table between two lines, ``<!-- table NAME PART -->`` and ``<!-- end -->``: that part of the file
``NAME.json``. The file's ``kind`` says how it is read: :mod:`rsjax.tools.studies.transcribed`.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rsjax.errors import UserError, did_you_mean
from rsjax.files import read_json, write_file
from rsjax.tools.studies.tables import as_markdown
from rsjax.tools.studies.transcribed import transcribed_table

FOLDER = Path("docs/results")
DATA = FOLDER / "data"
GENERATED = re.compile(
    r"(?P<start><!-- table (?P<name>\S+) (?P<part>\S+) -->\n)(?P<table>.*?)(?P<end><!-- end -->)", re.S
)


def pages(root: Path) -> list[Path]:
    """Returns the pages that may have generated tables."""
    return [root / "README.md", *sorted((root / FOLDER).glob("*.md"))]


def part_of(root: Path, name: str, part: str) -> str:
    """Returns one part of a file of results as Markdown.

    Raises:
        UserError: there is no such file or no such part.
    """
    names = [path.stem for path in (root / DATA).glob("*.json")]
    if name not in names:
        raise UserError(f"{DATA} has no {name}.json{did_you_mean(name, names)}")
    content = read_json(root / DATA / f"{name}.json")
    tables: dict[str, Any] = content["tables"]
    if part not in tables:
        raise UserError(f"{DATA}/{name}.json has no part {part}{did_you_mean(part, tables)} ({', '.join(tables)})")
    return as_markdown(transcribed_table(tables[part]), aligned=False)


def generated(root: Path, page: Path) -> str:
    """Returns a page's text with its tables made anew.

    Raises:
        UserError: a table names a file or a part that does not exist.
    """
    return GENERATED.sub(lambda found: f"{found['start']}{_table(root, page, found)}{found['end']}", page.read_text())


def _table(root: Path, page: Path, found: re.Match[str]) -> str:
    try:
        return part_of(root, found["name"], found["part"]) + "\n"
    except UserError as error:
        raise UserError(f"{page.relative_to(root)}: {error}") from error


def write_pages(root: Path) -> list[Path]:
    """Makes the tables of all pages anew, and returns the pages that have changed."""
    changed = []
    for page in pages(root):
        text = generated(root, page)
        if text != page.read_text():
            write_file(page, text.encode())
            changed.append(page)
    return changed


def differences(root: Path) -> Iterator[str]:
    """Yields a line for each table that differs from its file, and for each table of a result that has none."""
    for page in pages(root):
        where = page.relative_to(root)
        text = page.read_text()
        for found in GENERATED.finditer(text):
            if found["table"] != _table(root, page, found):
                yield f"{where}: table {found['name']} {found['part']} differs from {DATA}/{found['name']}.json"
        if page.parent == root / FOLDER:
            for line in re.findall(r"^\|.*$", GENERATED.sub("", text), re.M):
                yield f"{where}: a table outside the marks of a generated one: {line[:60]}"
                break
