"""Pages whose tables are generated from files of results.

A page has a table between two lines, ``<!-- table NAME PART -->`` and ``<!-- end -->``: that part of the file
``NAME.json``. The file's ``kind`` says how it is read: "measured" (:mod:`rsjax.tools.studies.paper.result_files`),
"run" (:mod:`rsjax.tools.studies.run_results`), "detector" (:mod:`rsjax.tools.detector.training`), "softness"
(:mod:`rsjax.tools.studies.softness`) or "transcribed" (:mod:`rsjax.tools.studies.transcribed`). A picture
``docs/results/NAME.png`` that a page shows is drawn from ``NAME.json`` if that was measured.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from PIL import Image

from rsjax.errors import UserError, did_you_mean
from rsjax.files import read_json, write_file
from rsjax.models.load_run import load_config
from rsjax.tools.detector import training
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies import run_results, softness
from rsjax.tools.studies.paper.claim_tables import claim_content, claim_figure, claim_tables
from rsjax.tools.studies.paper.report import RESULTS
from rsjax.tools.studies.paper.result_files import (
    KIND,
    about_result,
    claim_result_key,
    merge_claim_result,
    read_claim_result,
)
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
    path = root / DATA / f"{name}.json"
    content = read_json(path)
    below = ""
    if content["kind"] == KIND:
        claim = claim_content(read_claim_result(path))
        tables = claim_tables(claim)
        below = f"\n\n{claim['caption']} {about_result(path)}."
    elif content["kind"] == run_results.KIND:
        tables = run_results.run_tables(content)
        below = f"\n\n{run_results.about_runs(content)}"
    elif content["kind"] == training.KIND:
        tables = training.tables(content["rows"])
        below = f"\n\n{about_result(path)}."
    elif content["kind"] == softness.KIND:
        tables = softness.tables(content)
        below = f"\n\n{softness.summary(content)}"
    else:
        tables = {key: transcribed_table(table) for key, table in content["tables"].items()}
    if part not in tables:
        raise UserError(f"{DATA}/{name}.json has no part {part}{did_you_mean(part, tables)} ({', '.join(tables)})")
    return as_markdown(tables[part], aligned=False) + below


def add_result(root: Path, study: Path, claim: str, name: str = "", *, merge: bool = False) -> Path:
    """Copies what a study measured for a claim to the files of results, and returns the new file.

    Args:
        study: a directory of ``rsjax paper``.
        name: the new file's name; empty: the claim's.
        merge: keep the trainings of the file whose seeds the study lacks.

    Raises:
        UserError: the study has no finished training of the claim, or cannot be merged with the file.
    """
    source = study / RESULTS / f"{claim}.json"
    if not source.exists():
        known = [path.stem for path in (study / RESULTS).glob("*.json")]
        raise UserError(f"--add {claim!r}: {source}: no such file{did_you_mean(claim, known)} (rsjax paper writes it)")
    path = root / DATA / f"{name or claim}.json"
    if merge:
        merge_claim_result(path, source)
        return path
    for suffix in (".json", ".npz"):
        path.with_suffix(suffix).unlink(missing_ok=True)
        if source.with_suffix(suffix).exists():
            write_file(path.with_suffix(suffix), source.with_suffix(suffix).read_bytes())
    return path


def add_runs(root: Path, runs: Sequence[Path], name: str) -> Path:
    """Writes the scores of finished runs to the files of results, and returns the new file.

    Args:
        runs: directories of runs that differ in their seeds.

    Raises:
        UserError: a run is missing or not finished.
    """
    path = root / DATA / f"{name}.json"
    run_results.write_runs(path, [Run(load_config(run), run, Path("data")) for run in runs])
    return path


def generated(root: Path, page: Path) -> str:
    """Returns a page's text with its tables made anew.

    Raises:
        UserError: a table names a file or a part that does not exist.
    """
    return GENERATED.sub(lambda match: f"{match['start']}{_table(root, page, match)}{match['end']}", page.read_text())


def _table(root: Path, page: Path, match: re.Match[str]) -> str:
    try:
        return part_of(root, match["name"], match["part"]) + "\n"
    except UserError as error:
        raise UserError(f"{page.relative_to(root)}: {error}") from error


def figures(root: Path) -> Iterator[tuple[Path, Path]]:
    """Yields each picture that a page shows and that is drawn from a file of results, with this file."""
    for page in pages(root):
        for link in re.findall(r"\]\(([\w./-]+)\.png\)", page.read_text()):
            picture = (page.parent / f"{link}.png").resolve()
            data = root / DATA / f"{picture.stem}.json"
            if picture.parent == (root / FOLDER).resolve() and data.exists() and read_json(data)["kind"] == KIND:
                yield picture, data


def _is_of(picture: Path, data: Path) -> bool:
    """Returns whether a picture was drawn from a file of results as it is now."""
    if not picture.exists():
        return False
    with Image.open(picture) as image:
        return image.info.get("Source") == claim_result_key(data)


def write_pages(root: Path) -> list[Path]:
    """Makes the tables of all pages and their figures anew, and returns the files that have changed."""
    changed = []
    for page in pages(root):
        text = generated(root, page)
        if text != page.read_text():
            write_file(page, text.encode())
            changed.append(page)
    for picture, data in figures(root):
        if not _is_of(picture, data):
            write_file(picture, claim_figure(read_claim_result(data), claim_result_key(data)) or b"")
            changed.append(picture)
    return changed


def differences(root: Path) -> Iterator[str]:
    """Yields a line for each table or figure that differs from its file, and for each table of a result without one."""
    for page in pages(root):
        where = page.relative_to(root)
        text = page.read_text()
        for match in GENERATED.finditer(text):
            if match["table"] != _table(root, page, match):
                yield f"{where}: table {match['name']} {match['part']} differs from {DATA}/{match['name']}.json"
        if page.parent == root / FOLDER:
            for line in re.findall(r"^\|.*$", GENERATED.sub("", text), re.MULTILINE)[:1]:
                yield f"{where}: a table outside the marks of a generated one: {line[:60]}"
    for picture, data in figures(root):
        if not _is_of(picture, data):
            yield f"{FOLDER}/{picture.name}: the figure was not drawn from {DATA}/{data.name} as it is"
