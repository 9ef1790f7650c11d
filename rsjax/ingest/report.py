"""What became of every episode and every window: in numbers, in a table, and in lines of text."""

import dataclasses
import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsjax.errors import UserError
from rsjax.files import disk_guard, write_atomically
from rsjax.ingest.episode import EpisodeRef
from rsjax.ingest.jobs.runner import Ran
from rsjax.ingest.jobs.work_items import Job, Mark, Unit
from rsjax.progress import duration

QUARANTINE = "quarantine.jsonl"
SUMMARY = "summary.json"
WINDOWS = "windows.jsonl"


@dataclass(frozen=True)
class Counts:
    """What became of every episode: found = done + filtered + quarantined; and of windows.

    Attributes:
        found: episodes that the source lists.
        done: those that gave a clip.
        filtered: reason by episode, for those that were read and gave none.
        quarantined: rows of the quarantine table: ``episode``, ``stage``, ``key``, ``error``, ``option``
            (the one that rules the episode out, or ""), ``traceback``.
        windows: how many were ``kept``, and how many each reason left out.
        stages: of each, how many units are done and failed, the seconds that they took on a worker and on its cores,
            and the clips per second of such a worker.
        depth_left_out: clips whose depth has another unit than the store's, and that are in it without.
        ran: what of that was done just now.
    """

    found: int
    done: int
    filtered: dict[str, str]
    quarantined: list[dict[str, Any]]
    windows: dict[str, int]
    stages: dict[str, dict[str, Any]]
    depth_left_out: int = 0
    ran: Ran | None = None


def count(job: Job, refs: Sequence[EpisodeRef], refused: Sequence[tuple[EpisodeRef, str]] = ()) -> Counts:
    """Counts by the marks of a job that was run to its end; its last stage makes the clips.

    Args:
        refused: further episodes that are not in the result, and why.

    Raises:
        UserError: a unit has no mark.
    """
    filtered: dict[str, str] = {}
    short: dict[str, dict[str, Any]] = {}
    quarantined = [dict(zip(_ROW, (ref.id, "list", ref.fingerprint, why, "", ""), strict=True)) for ref, why in refused]
    windows = Counter({"kept": 0})
    zeros = {"done": 0, "failed": 0, "seconds": 0.0, "cpu_seconds": 0.0}
    stages: dict[str, dict[str, Any]] = {stage.name: dict(zeros) for stage in job.stages}
    done = clips = 0
    for ref in refs:
        marks = _marks(job, ref)
        for mark in marks:
            stages[mark["stage"]][mark["status"]] += 1
            for name in ("seconds", "cpu_seconds"):
                stages[mark["stage"]][name] += mark[name]
        last = marks[-1]
        if last["status"] == "failed":
            quarantined.append({name: last.get(name, "") for name in _ROW} | {"error": _plain(last["error"])})
            continue
        windows.update(last["summary"]["windows"])
        clips += last["records"]
        done += bool(last["records"])
        if not last["records"]:
            filtered[ref.id] = _told(last["summary"]["windows"])
            if not filtered[ref.id]:
                short[ref.id] = last["summary"]["short"]
    filtered |= _too_short(short)
    for row in stages.values():
        row["clips_per_second"] = clips / row["seconds"] if row["seconds"] else None
    return Counts(len(refs) + len(refused), done, filtered, quarantined, dict(windows), stages)


def write_tables(folder: Path, counts: Counts) -> None:
    """Writes the quarantine table (a JSON object per line) and the summary, which has everything else."""
    with disk_guard(folder):
        rows = [json.dumps(row) for row in counts.quarantined]
        write_atomically(folder / QUARANTINE, "".join(f"{row}\n" for row in rows).encode())
        summary = dataclasses.asdict(counts) | {"quarantined": len(counts.quarantined)}
        write_atomically(folder / SUMMARY, json.dumps(summary, indent=1).encode())


def write_windows(job: Job, refs: Sequence[EpisodeRef]) -> None:
    """Writes which windows were left out of each episode that was cut, by their first frames and why, a line each."""
    path, last = job.folder / WINDOWS, job.stages[-1].name
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    with disk_guard(path):
        try:
            with temporary.open("w") as file:
                for ref in refs:
                    mark = job.mark(Unit(ref, last))
                    if mark is not None and mark["status"] == "done" and mark["summary"]["left_out"]:
                        row = {"episode": ref.id, "left_out": mark["summary"]["left_out"]}
                        file.write(f"{json.dumps(row)}\n")
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def _marks(job: Job, ref: EpisodeRef) -> list[Mark]:
    """An episode's, up to the first failed one."""
    marks: list[Mark] = []
    for stage in job.stages:
        unit = Unit(ref, stage.name)
        mark = job.mark(unit)
        if mark is None:
            raise UserError(f"{job.output(unit)}: not there; the job is not finished, run it again")
        marks.append(mark)
        if mark["status"] == "failed":
            break
    return marks


_ROW = ("episode", "stage", "key", "error", "option", "traceback")


def _told(windows: dict[str, int]) -> str:
    left = [f"{number} {reason}" for reason, number in windows.items() if number]
    return f"windows left out: {', '.join(left)}" if left else ""


def _too_short(episodes: dict[str, dict[str, Any]]) -> dict[str, str]:
    """Why these gave no window; in the same words where the same would cure it."""
    told = {name: (short["window"], short["cure"]) for name, short in episodes.items()}
    longest: dict[tuple[str, str], int] = {}
    for name, same in told.items():
        longest[same] = max(longest.get(same, 0), episodes[name]["longest"])
    return {
        name: f"shorter than a window ({same[0]}; the longest has {longest[same]}): {same[1]}"
        for name, same in told.items()
    }


def _plain(error: str) -> str:
    """A failure's words, without the name of its class where that is one that a user can put right."""
    name, _, told = error.partition(": ")
    return told if name in _names(UserError) else error


def _names(kind: type[UserError]) -> set[str]:
    parts: list[set[str]] = [_names(one) for one in kind.__subclasses__()]
    return {kind.__name__}.union(*parts)


def blamed(counts: Counts) -> str:
    """The one option that ruled out every quarantined episode; "" where there is none."""
    options = {row["option"] for row in counts.quarantined}
    return options.pop() if len(options) == 1 else ""


def tables(counts: Counts) -> str:
    """The files that say what was left out and why, as far as they hold something."""
    windows = sum(number for reason, number in counts.windows.items() if reason != "kept")
    held = {SUMMARY: counts.filtered, QUARANTINE: counts.quarantined, WINDOWS: windows}
    return " and ".join(name for name, holds in held.items() if holds)


def nothing(counts: Counts, folder: Path) -> str:
    """Why no episode gave a clip, in one line.

    Args:
        folder: where the tables are.
    """
    option, reasons = blamed(counts), [row["error"] for row in counts.quarantined] + list(counts.filtered.values())
    because = f", all {len(counts.quarantined)} of these because of {option}" if option else ""
    return (
        f"none of {counts.found} episodes gave a clip ({len(counts.filtered)} left out, {len(counts.quarantined)} "
        f"quarantined{because}), the first one for: {reasons[0]}; {folder} has all of them in {tables(counts)}"
    )


def lines(counts: Counts) -> list[str]:
    """Episodes, windows, and each stage's share, in lines of text; numbers of episodes and of windows add up."""
    windows = sum(counts.windows.values())
    left = [f"{number} {reason}" for reason, number in counts.windows.items() if reason != "kept" and number]
    found = [
        f"episodes  {counts.found} found = {counts.done} with clips + {len(counts.filtered)} without + "
        f"{len(counts.quarantined)} quarantined",
        f"windows   {windows} found = {counts.windows['kept']} kept" + "".join(f" + {reason}" for reason in left),
    ]
    if counts.depth_left_out:
        found.append(f"depth     left out of {counts.depth_left_out} clips: metres and relative depth do not mix")
    if counts.ran is not None:
        found.append(
            f"this run  {counts.ran.units} units in {_brief(counts.ran.seconds)}, {counts.ran.clips} clips, "
            f"{counts.ran.clips_per_second:.3g} clips/s"
        )
    for name, row in counts.stages.items():
        rate = f", {row['clips_per_second']:.3g} clips/s a worker" if row["clips_per_second"] else ""
        found.append(
            f"{name:<9} {row['done']} done, {row['failed']} failed, {_brief(row['seconds'])} on workers, "
            f"{_brief(row['cpu_seconds'])} on cores{rate}"
        )
    found += [f"without   {number}×: {reason}" for reason, number in Counter(counts.filtered.values()).most_common(3)]
    worst = [f"quarantined {row['episode']} at {row['stage']}: {row['error']}" for row in counts.quarantined[:3]]
    option = blamed(counts)
    because = [f"quarantined all {len(counts.quarantined)} because of {option}"] if option else []
    return found + because + worst + ([f"… {len(counts.quarantined) - 3} more"] if len(counts.quarantined) > 3 else [])


def _brief(seconds: float) -> str:
    return duration(seconds) if seconds >= 60 else f"{seconds:.2g} s"
