"""All cases."""

from collections.abc import Iterator

from benchmarks.hostile import damaged, interfaces, options, servers
from benchmarks.hostile.cases import Case


def all_cases() -> Iterator[Case]:
    """Yields every case; names are unique."""
    for module in (options, damaged, interfaces, servers):
        yield from module.cases()
