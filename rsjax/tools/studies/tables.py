"""The one renderer of tables: every study builds a :class:`Table` and shows it as Markdown or HTML."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from markupsafe import Markup, escape

from rsjax.evaluation.statistics import Estimate
from rsjax.tools.studies.results import Spread

ABSENT = "–"  # stands in place of a missing number
_SUPERSCRIPT = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Marked:
    """The text of a cell with its meaning.

    Attributes:
        mark: "best" is bold in Markdown; "note" is faint (italic in Markdown); "met" is green, "missed" is red and
            "published" is apart in HTML only.
        remark: a smaller text that follows.
    """

    text: str
    mark: Literal["", "best", "note", "met", "missed", "published"] = ""
    remark: str = ""


CellText: TypeAlias = str | Marked


@dataclass(frozen=True)
class Table:
    """A table of texts.

    Attributes:
        head: the headings of the columns.
        rows: as many texts in each row.
        first_bold: whether HTML shows the first row in bold.
    """

    head: Sequence[CellText]
    rows: Sequence[Sequence[CellText]]
    first_bold: bool = False


def as_markdown(table: Table, aligned: bool = True) -> str:
    """Returns a table as Markdown.

    Args:
        aligned: whether to align the columns in the source as well, which makes every line as long as the longest.
    """
    texts = [[_markdown_cell(cell) for cell in row] for row in (table.head, *table.rows)]
    if not aligned:
        lines = ["|".join(["", *(f" {text} ".replace("  ", " ") for text in row), ""]) for row in texts]
        return "\n".join([lines[0], "|" + "---|" * len(table.head), *lines[1:]])
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    texts.insert(1, ["-" * width for width in widths])
    lines = [" | ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) for row in texts]
    return "\n".join(f"| {line} |" for line in lines)


def _markdown_cell(cell: CellText) -> str:
    if isinstance(cell, str):
        return cell.replace("|", r"\|")
    text = cell.text.replace("|", r"\|")
    if cell.mark == "best":
        text = f"**{text}**"
    elif cell.mark == "note" and text:
        text = f"*{text}*"
    return f"{text}: {cell.remark}" if cell.remark else text


def as_html(table: Table) -> Markup:
    """Returns a table as HTML in the classes of ``report/style.css.j2``."""
    head = "".join(_html_cell("th", cell) for cell in table.head)
    lines = ['<div class="scroll"><table>', f"<thead><tr>{head}</tr></thead>", "<tbody>"]
    for number, row in enumerate(table.rows):
        start = '<tr class="first">' if table.first_bold and number == 0 else "<tr>"
        lines.append(f"{start}{''.join(_html_cell('td', cell) for cell in row)}</tr>")
    return Markup("\n".join([*lines, "</tbody></table></div>"]))


def _html_cell(tag: str, cell: CellText) -> str:
    if isinstance(cell, str):
        return f"<{tag}>{escape(cell)}</{tag}>"
    kind = f' class="{cell.mark}"' if cell.mark else ""
    remark = f"<small>{escape(cell.remark)}</small>" if cell.remark else ""
    return f"<{tag}{kind}>{escape(cell.text)}{remark}</{tag}>"


def as_csv(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Returns values as CSV, unrounded; None is empty."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    return text.getvalue()


def number_text(value: float | None, form: str) -> str:
    """Returns a number in a format such as ``.3f``; "–" for None."""
    if value is None:
        return ABSENT
    return format(value, form)


def mean_text(spread: Spread | None, decimals: int, seeds: int = 0) -> str:
    """Returns ``mean ± sample deviation``, the mean alone for a single value, or "–" for None.

    Args:
        seeds: how many seeds there are; if some lack the score, the text says how many have it. 0: unknown.
    """
    if spread is None:
        return ABSENT
    text = f"{spread.mean:.{decimals}f}"
    if spread.std is not None:
        text += f" ± {spread.std:.{decimals}f}"
    if seeds and spread.n < seeds:
        text += f" ({spread.n} of {seeds} seeds)"
    return text


def p_text(p: float) -> str:
    """Returns a p-value with three digits after the point."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def interval_text(interval: Estimate | None, decimals: int) -> str:
    """Returns ``[low, high]``; "" without an interval."""
    if interval is None or interval.low is None or interval.high is None:
        return ""
    return f"[{interval.low:.{decimals}f}, {interval.high:.{decimals}f}]"


class Footnotes:
    """Numbers the reasons for absent metrics in the order in which a table mentions them.

    Attributes:
        texts: the footnotes mentioned so far.
    """

    def __init__(self) -> None:
        self._numbers: dict[str, str] = {}

    def absent(self, reason: str | None) -> str:
        """Returns what stands in place of a number: a dash with the reason's mark, such as "–²"; "–" without one."""
        if not reason:
            return ABSENT
        number = str(len(self._numbers) + 1).translate(_SUPERSCRIPT)
        return ABSENT + self._numbers.setdefault(reason, number)

    @property
    def texts(self) -> list[str]:
        """The reasons with their marks, in order."""
        return [f"{mark} {reason}" for reason, mark in self._numbers.items()]
