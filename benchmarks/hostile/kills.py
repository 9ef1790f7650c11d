"""Kills commands at random moments, and compares what they end with. ``python -m benchmarks.hostile.kills``"""

import fnmatch
import json
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.hostile.cases import Place, fill
from benchmarks.hostile.material import make
from benchmarks.soak.attempt import Attempt
from benchmarks.soak.compare import compare_arrays, compare_logs
from rsjax.files import write_file
from rsjax.tools.commands.cli import main_errors, parse_options

PROG = "python -m benchmarks.hostile.kills"
RUN = "MATERIAL/run --data-dir MATERIAL/data"
UNLABELLED = "MATERIAL/run --data-dir MATERIAL/unlabelled"
POLICY = "MATERIAL/policy"
TRIALS = "--episodes 2 --max-steps 3 --together 1"
ROLLOUTS = "--steps 4 --rollouts 2 --held-out 2 --trials 2 --max-steps 6 --together 1"
CELL = "--size toy --steps 4 --counts 2 --cells synthetic-2 --synthetic MATERIAL/synthetic/clips"
ROUND = "--demos 6 --size toy --rounds 1 --imagined 2 --steps 2"
COMMANDS = {
    "synthesize": f"synthesize {RUN} --demos 6 --only all --batch 2 --out NEW",
    "export": "export lerobot MATERIAL/store NEW --split all",
    "adapt": f"adapt {RUN} --policy {POLICY} {ROLLOUTS} --out NEW",
    "finetune": "finetune MATERIAL/run --data MATERIAL/store --steps 4 --tokenizer keep --out NEW",
    "policy_learning": f"policy_learning {UNLABELLED} {CELL} {TRIALS} --out NEW",
    "policy_evaluation": f"policy_evaluation {RUN} --policies {POLICY} {POLICY}/at-2 --imagined 2 {TRIALS} --out NEW",
    "improve": f"improve {UNLABELLED} --policy {POLICY} {ROUND} {TRIALS} --out NEW",
    "record": f"record {RUN} --policies {POLICY} --episodes 3 --together 1 --out NEW",
}
# What may differ: measured times, and files that hold them. Checkpoints and logs are compared by what is in them.
FREE = (
    "*.lock",
    ".lock",
    "made.json",
    "run.json",
    "report.html",
    "events.out.*",
    "checkpoints",
    "log.jsonl",
    "coverage",
)
MEASURED = ("seconds", "time", "made", "date")


@dataclass(frozen=True)
class Options:
    """Runs each command once in peace and then with kills at random moments; both must end with the same bytes."""

    out: Path = Path("runs/kills")
    """Directory of the material and the results."""
    material: Path | None = None
    """Material that exists already, such as that of benchmarks.hostile. Default: made in --out."""
    only: tuple[str, ...] = ()
    """Commands to kill. Default: all."""
    kills: int = 5
    """Kills of each command."""
    seed: int = 0
    """Of the moments."""


@main_errors()
def main() -> None:
    """Writes kills.md, and exits with 1 if a command failed or ended differently."""
    options = parse_options(sys.argv[1:], PROG, Options.__doc__ or "", Options())
    out = options.out.absolute()
    material = (options.material or out / "material").absolute()
    make(material)
    unlabel(material)
    rows = ["| command | in peace, s | kills at, s | same bytes |", "|---|---|---|---|"]
    bad = []
    for name, line in COMMANDS.items():
        if options.only and name not in options.only:
            continue
        seconds, moments, found = kill(fill(line, Place(material, out / name)).split(), out / name, options, name)
        bad += [f"- {name}: {line}" for line in found]
        at = ", ".join(f"{moment:.1f}" for moment in moments)
        rows.append(f"| {name} | {seconds:.0f} | {at} | {'no' if found else 'yes'} |")
        print(rows[-1], *found, sep="\n", flush=True)
    text = "\n".join([*rows, "", *bad, ""])
    write_file(out / "kills.md", text.encode())
    print(text)
    if bad:
        raise SystemExit(1)


def unlabel(material: Path) -> None:
    """Copies the data set without the share of successes: its short episodes have none, so all are demonstrations."""
    copied = material / "unlabelled"
    if copied.exists():
        return
    shutil.copytree(material / "data", copied, symlinks=True)
    for path in copied.glob("*/manifest.json"):
        manifest = json.loads(path.read_text())
        manifest["success_share"] = None
        write_file(path, json.dumps(manifest).encode())


def kill(words: list[str], folder: Path, options: Options, name: str) -> tuple[float, list[float], list[str]]:
    """Runs a command in peace, and again with kills.

    Returns:
        The seconds that it takes in peace, those after which it was killed, and what differs.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    command = [sys.executable, "-m", f"experiments.{words[0]}", *words[1:]]
    log = folder / "output.log"
    began = time.monotonic()
    status = _to_the_end(command, log)
    seconds = time.monotonic() - began
    if status:
        return seconds, [], [f"exit status {status} in peace; see {log}"]
    new = folder / "new"
    new.rename(folder / "peace")
    rng = random.Random(f"{options.seed} {name}")
    moments: list[float] = []
    shortest = seconds
    for _ in range(3 * options.kills):
        if len(moments) == options.kills:
            break
        moment = rng.uniform(0.1, shortest)
        anew = not new.exists()
        began = time.monotonic()
        attempt = Attempt(command, [folder], log)
        try:
            attempt.process.wait(moment)
        except subprocess.TimeoutExpired:
            attempt.kill()
            moments.append(moment)
            continue
        if attempt.process.returncode:
            return seconds, moments, [f"exit status {attempt.process.returncode} after {len(moments)} kills; see {log}"]
        if anew:
            shortest = min(shortest, time.monotonic() - began)  # what was compiled before saves it time
        shutil.rmtree(new)  # once more from the beginning
    if not new.exists() or name != "export":  # an export that is there is whole, and refuses another one
        status = _to_the_end(command, log)
        if status:
            return seconds, moments, [f"exit status {status} after {len(moments)} kills; see {log}"]
    return seconds, moments, list(differences(folder / "peace", new))


def _to_the_end(command: list[str], log: Path) -> int:
    with log.open("ab") as file:
        return subprocess.run(command, stdin=subprocess.DEVNULL, stdout=file, stderr=file).returncode


def differences(one: Path, two: Path) -> Iterator[str]:
    """Yields a line for each file that differs between two directories in more than measured times."""
    here = set(_files(one))
    there = set(_files(two))
    for path in sorted(here ^ there):
        yield f"{path} is only in {'the first' if path in here else 'the second'}"
    for path in sorted(here & there):
        first = one / path
        second = two / path
        if path.name == "weights":
            yield from (f"{path}: {line}" for line in compare_arrays(first, second))
        elif path.suffix == ".json":
            if _unmeasured(json.loads(first.read_text())) != _unmeasured(json.loads(second.read_text())):
                yield f"{path} differs"
        elif first.read_bytes() != second.read_bytes():
            yield f"{path} differs"
    for log in sorted(one.rglob("log.jsonl")):
        stage = log.parent.relative_to(one)
        yield from (f"{stage}: {line}" for line in compare_logs(one / stage, two / stage))


def _files(folder: Path) -> Iterator[Path]:
    """Yields the files to compare, and instead of their files the directories of weights."""
    for path in sorted(folder.iterdir()):
        if any(fnmatch.fnmatch(path.name, pattern) for pattern in FREE):
            continue
        if path.is_dir() and not path.is_symlink() and path.name != "weights":
            yield from (Path(path.name) / inner for inner in _files(path))
        elif not path.is_symlink():
            yield Path(path.name)


def _unmeasured(value: Any) -> Any:
    """Returns a JSON value without entries whose names say that they are measured times."""
    if isinstance(value, dict):
        return {name: _unmeasured(each) for name, each in value.items() if not any(word in name for word in MEASURED)}
    if isinstance(value, list):
        return [_unmeasured(each) for each in value]
    return value


if __name__ == "__main__":
    main()
