"""Gives hostile and absurd inputs to every border. ``python -m benchmarks.hostile --out runs/hostile``"""

import fnmatch
import json
import os
import random
import select
import shlex
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.hostile.cases import BAD, GOOD, Case
from benchmarks.hostile.material import make
from benchmarks.hostile.table import all_cases
from rsjax.files import write_file
from rsjax.tools.commands.cli import main_errors, parse_options

PROG = "python -m benchmarks.hostile"
STARTING = 300.0  # seconds that a worker may take to import everything
FRESH = 400  # cases of a worker


@dataclass(frozen=True)
class Options:
    """Gives hostile inputs to commands, files, play, the server, environments and the API; each must end well."""

    out: Path = Path("runs/hostile")
    """Directory of the material and the results; the same command goes on where it was stopped."""
    only: tuple[str, ...] = ()
    """Cases to run, by shell pattern of their names: 'options: serve*' 'files: *'. Default: all."""
    again: tuple[str, ...] = ()
    """Verdicts of an earlier run whose cases are run again, such as traceback hang; or bad, for all that are."""
    seconds: float = 60.0
    """Time limit of a case."""
    minutes: float = 1e6
    """Minutes after which to stop; the same command goes on."""
    list: bool = False
    """Print the names of the cases, and run nothing."""


@main_errors()
def main() -> None:
    """Runs the cases that have no verdict yet, writes hostile.md, and exits with 1 if a case ended badly."""
    options = parse_options(sys.argv[1:], PROG, Options.__doc__ or "", Options())
    chosen = [
        case
        for case in all_cases()
        if not options.only or any(fnmatch.fnmatch(case.name, each) for each in options.only)
    ]
    if options.list:
        print("\n".join(case.name for case in chosen))
        return
    results = run(chosen, options)
    text = summary(results, shlex.join([*PROG.split(), *sys.argv[1:]]))
    write_file(options.out / "hostile.md", text.encode(errors="backslashreplace"))
    print(text)
    if any(row["verdict"] in BAD for row in results.values()):
        raise SystemExit(1)


def run(cases: Sequence[Case], options: Options) -> dict[str, dict[str, Any]]:
    """Returns how each case ended, by name; cases of an earlier run of ``out`` keep their verdict."""
    out = options.out.absolute()
    make(out / "material")
    file = out / "results.jsonl"
    done = {}
    for line in file.read_text().splitlines() if file.exists() else ():
        row = json.loads(line)
        done[row["name"]] = row
    repeated = {*options.again}
    if "bad" in repeated:
        repeated |= {*BAD}
    left = [case for case in cases if case.name not in done or done[case.name]["verdict"] in repeated]
    random.Random(0).shuffle(left)  # so that a run that is stopped has tried something of everything
    ends = time.monotonic() + 60 * options.minutes
    worker: Worker | None = None
    with file.open("a") as log:
        for number, case in enumerate(left):
            if worker is None or worker.cases >= FRESH:
                if worker is not None:
                    worker.close()
                worker = Worker(out)
            began = time.monotonic()
            if began > ends:
                break
            row = {"name": case.name} | worker.ask(case.name, options.seconds)
            row["seconds"] = round(time.monotonic() - began, 2)
            if row["verdict"] in ("hang", "died"):
                worker.close()
                worker = None
            done[case.name] = row
            print(json.dumps(row), file=log, flush=True)
            if row["verdict"] in BAD or number % 100 == 99:
                print(f"{number + 1}/{len(left)} {row['verdict']}: {case.name}", flush=True)
    if worker is not None:
        worker.close()
    return {case.name: done[case.name] for case in cases if case.name in done}


class Worker:
    """A process that runs cases on a fresh copy of the material."""

    def __init__(self, out: Path) -> None:
        self._material = out / "copy" / "material"
        shutil.rmtree(self._material.parent, ignore_errors=True)
        copy(out / "material", self._material)
        self._log = (out / "worker.log").open("ab")
        self.cases = 0
        self._groups: set[str] = set()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.hostile.worker", str(self._material)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
            cwd=out,
        )

    def ask(self, name: str, seconds: float) -> dict[str, Any]:
        """Runs a case, and returns its verdict."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{json.dumps(name)}\n".encode())
        self._process.stdin.flush()
        group = name.partition(":")[0]
        if group not in self._groups:  # its servers and environments start, and compile
            seconds += STARTING
            self._groups.add(group)
        self.cases += 1
        ready, _, _ = select.select([self._process.stdout], [], [], seconds)
        if not ready:
            return {"verdict": "hang", "kind": "hang", "text": f"not over after {seconds:g} s"}
        line = self._process.stdout.readline()
        if not line:
            return {"verdict": "died", "kind": "died", "text": f"the process ended with status {self._process.wait()}"}
        answer: dict[str, Any] = json.loads(line)
        return answer

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.wait()
        self._log.close()


def copy(material: Path, to: Path) -> None:
    """Copies the material with its fifo."""
    shutil.copytree(material, to, symlinks=True, ignore=shutil.ignore_patterns("fifo"))
    os.mkfifo(to / "fifo")


def summary(results: dict[str, dict[str, Any]], line: str) -> str:
    """Returns a table of verdicts by group, and each case that ended badly."""
    groups = sorted({name.partition(":")[0] for name in results})
    shown = [verdict for verdict in (*GOOD, *BAD) if any(row["verdict"] == verdict for row in results.values())]
    rows = [f"| inputs | {' | '.join(shown)} | all |", f"|{'---|' * (len(shown) + 2)}"]
    for group in (*groups, "all"):
        counts = Counter(row["verdict"] for name, row in results.items() if group in ("all", name.partition(":")[0]))
        rows.append(f"| {group} | {' | '.join(str(counts[verdict]) for verdict in shown)} | {counts.total()} |")
    bad = [
        f"- {row['verdict']}: {name}\n  {_last(row['text'])}" for name, row in results.items() if row["verdict"] in BAD
    ]
    return "\n".join([f"`{line}`", "", *rows, "", *bad, ""])


def _last(text: str) -> str:
    return text.strip().rpartition("\n")[2][:300]


if __name__ == "__main__":
    main()
