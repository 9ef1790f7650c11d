"""Labels of a clip for a curriculum: its task's difficulty and its scene, from tables of patterns."""

import csv
import fnmatch
from dataclasses import dataclass
from pathlib import Path

from rsjax.clip import UNKNOWN
from rsjax.config import ConfigError

AGIBOT = "agibot"  # stands for the table of AgiBot-World's tasks (docs/agibot.md)
Table = tuple[tuple[str, str], ...]  # shell pattern (case is ignored) and label; the first match counts


@dataclass(frozen=True)
class CategoryConfig:
    """The tables of patterns. Difficulty is a label of whole tasks, chosen by hand, as in the paper.

    Attributes:
        difficulties: matched against the task's text, then against a segment's text and its skill.
        scenes: matched against the episode's description of its scene; without a table the description is the label.
    """

    difficulties: Table = ()
    scenes: Table = ()

    def difficulty(self, task: str, segment: str = "", skill: str = "") -> str:
        """Returns the difficulty of a clip with this task, in this segment; ``unknown`` if no pattern matches."""
        labels = (look_up(self.difficulties, text) for text in (task, segment, skill))
        return next((label for label in labels if label != UNKNOWN), UNKNOWN)

    def scene(self, description: str) -> str:
        """Returns the scene's label; ``unknown`` without a description or a match."""
        if self.scenes:
            return look_up(self.scenes, description)
        return description or UNKNOWN


def look_up(table: Table, text: str) -> str:
    """Returns the label of the first pattern that matches the text, ignoring case; ``unknown`` if none does."""
    matching = (label for pattern, label in table if fnmatch.fnmatchcase(text.lower(), pattern.lower()))
    return next(matching, UNKNOWN)


def parse_table(field: str, rows: tuple[str, ...]) -> Table:
    """Parses rows such as ``pick*=simple``; the word ``agibot`` stands for the rows of AgiBot-World's tasks.

    Args:
        field: the option's name, for the error message.

    Raises:
        ConfigError: a row is not of this form.
    """
    table: list[tuple[str, str]] = []
    for row in rows:
        if (field, row) == ("--difficulty", AGIBOT):
            table += agibot_difficulties()
            continue
        pattern, equals, label = row.rpartition("=")
        if not (equals and pattern and label):
            raise ConfigError(f"{field} {row!r}: write PATTERN=WORD, such as 'pick*=simple'")
        if pattern in dict(table):
            raise ConfigError(
                f"{field} {row!r}: {pattern!r} has the word {dict(table)[pattern]!r} already; give it once"
            )
        table.append((pattern, label))
    return tuple(table)


def agibot_difficulties() -> Table:
    """Returns a pattern for each name of AgiBot-World's tasks, longer ones first, since one name begins another."""
    text = Path(__file__).with_name("agibot_tasks.tsv").read_text(encoding="utf-8")
    rows = csv.DictReader(text.splitlines(), delimiter="\t")
    table = [(f"{row['name']}*", row["difficulty"]) for row in rows]
    return tuple(sorted(table, key=lambda row: -len(row[0])))
