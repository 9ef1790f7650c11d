import os
import subprocess
import sys
from pathlib import Path

import pytest

from rsjax.runtime import HUGE_PAGES

ROOT = Path(__file__).parents[1]
# Prints its tunables and arguments, and appends its process id to a file at each start.
PROGRAM = """
import os, sys
open(sys.argv[1], "a").write(f"{os.getpid()} ")
from rsjax.runtime import tune_process
tune_process()
print(os.environ.get("GLIBC_TUNABLES"), *sys.argv[2:], sep="\\n")
"""

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="tuning is only for Linux")


def run(starts: Path, tunables: str | None, *arguments: str) -> tuple[list[str], list[str]]:
    """Returns the lines that the program printed and the process id of each of its starts."""
    environment = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"}
    environment |= {"GLIBC_TUNABLES": tunables} if tunables is not None else {}
    line = [sys.executable, "-X", "dev", "-c", PROGRAM, str(starts), *arguments]
    done = subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines(), starts.read_text().split()


@pytest.mark.parametrize(
    ("before", "after"),
    [(None, HUGE_PAGES), ("glibc.malloc.check=1", f"glibc.malloc.check=1:{HUGE_PAGES}")],
)
def test_restarts_once_as_the_same_process_with_the_same_arguments(
    tmp_path: Path, before: str | None, after: str
) -> None:
    lines, starts = run(tmp_path / "starts", before, "--flag", "two words", "")
    assert lines == [after, "--flag", "two words", ""]
    assert len(starts) == 2
    assert len(set(starts)) == 1


def test_a_tunable_that_the_user_set_stays(tmp_path: Path) -> None:
    lines, starts = run(tmp_path / "starts", "glibc.malloc.hugetlb=0", "a")
    assert lines == ["glibc.malloc.hugetlb=0", "a"]
    assert len(starts) == 1
