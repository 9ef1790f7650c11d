"""A clip's words for a curriculum: how difficult its task is and where it plays, out of tables of patterns."""

import fnmatch
from dataclasses import dataclass

from rsjax.config import ConfigError

UNKNOWN = "unknown"
Table = tuple[tuple[str, str], ...]  # pattern (a shell's, any case) and word; the first that matches counts


@dataclass(frozen=True)
class CategoryConfig:
    """The tables. The paper sorts whole tasks into simple and difficult by hand; so do these.

    Attributes:
        difficulties: by the task's text; where none matches it, by a part's text, and then by its skill.
        scenes: by the episode's own description of its scene; without a table the description itself counts.
    """

    difficulties: Table = ()
    scenes: Table = ()

    def difficulty(self, task: str, segment: str = "", skill: str = "") -> str:
        """Of a clip with this task, in this part of its episode: ``unknown`` where no pattern matches any of them."""
        words = (look_up(self.difficulties, text) for text in (task, segment, skill))
        return next((word for word in words if word != UNKNOWN), UNKNOWN)

    def scene(self, description: str) -> str:
        """Where it plays: ``unknown`` where that was not described, or no pattern matches."""
        return look_up(self.scenes, description) if self.scenes else description or UNKNOWN


def look_up(table: Table, text: str) -> str:
    """The word of the first pattern that matches the text, in any case; ``unknown`` where none does."""
    matching = (word for pattern, word in table if fnmatch.fnmatchcase(text.lower(), pattern.lower()))
    return next(matching, UNKNOWN)


def parse_table(field: str, rows: tuple[str, ...]) -> Table:
    """A table out of words such as ``pick*=simple``.

    Args:
        field: what the message calls them.

    Raises:
        ConfigError: one is not of this form.
    """
    table = []
    for row in rows:
        pattern, equals, word = row.rpartition("=")
        if not (equals and pattern and word):
            raise ConfigError(f"{field} {row!r}: write PATTERN=WORD, such as 'pick*=simple'")
        table.append((pattern, word))
    return tuple(table)
