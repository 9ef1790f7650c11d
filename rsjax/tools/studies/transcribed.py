"""Tables of earlier runs whose scores per clip were not kept: the cells as they were printed, with verdicts made anew.

A file says what its tables hold, and where it is from (``commit``, ``command``, ``machine``, ``date``). Each of its
tables has ``head`` and ``rows``, as they were printed. A table of comparisons also has ``judge``: ``lower``, the
metrics for which lower is better; ``family``, "table" if the whole table is one claim, "group" if each row with a first
cell begins another claim; ``further``, the p-values of comparisons of the same claim that the table leaves out.

Its interval is the one that was printed, from resampling seeds and clips. Welch's, which may be wider, can no longer be
computed, but its test is: a comparison is decided only if the interval and Holm's p agree.
"""

from collections.abc import Mapping
from typing import Any

from rsjax.evaluation.statistics import Estimate, holm, verdict
from rsjax.tools.studies.tables import CellText, Table, p_text

INTERVAL = "95 % interval"
SIGNIFICANT = 0.05


def transcribed_table(content: Mapping[str, Any]) -> Table:
    """Returns a table of a file; one of comparisons gets a column of adjusted p-values, and its verdicts.

    Args:
        content: an entry of the file's ``tables``.
    """
    head = content["head"]
    rows = content["rows"]
    if "judge" not in content:
        return Table(head, rows)
    place = {name: head.index(name) for name in ("p", INTERVAL, "verdict")}
    judge = content["judge"]
    begins = [number == 0 or (judge["family"] == "group" and bool(row[0])) for number, row in enumerate(rows)]
    starts = [number for number, first in enumerate(begins) if first]
    adjusted: list[float] = []
    for start, end in zip(starts, [*starts[1:], len(rows)], strict=True):
        family = [*(_number(row[place["p"]]) for row in rows[start:end]), *judge.get("further", ())]
        adjusted.extend(holm(family)[: end - start].tolist())
    judged = []
    for row, p in zip(rows, adjusted, strict=True):
        low, high = (_number(bound) for bound in row[place[INTERVAL]].split(" … "))
        lower = any(cell in judge["lower"] for cell in row)
        finding = verdict(Estimate((low + high) / 2, low, high), "lower" if lower else "higher")
        cells: list[CellText] = list(row)
        cells[place["verdict"]] = finding if p < SIGNIFICANT else "cannot tell"
        cells.insert(place["p"] + 1, p_text(p))
        judged.append(cells)
    return Table([*head[: place["p"] + 1], "p by Holm", *head[place["p"] + 1 :]], judged)


def _number(text: str) -> float:
    """Reads a printed number; "< 0.001" counts as 0.001."""
    return float(text.removeprefix("< "))
