"""Counts what became of every episode and every window of an ingest, and reports it in tables and lines of text."""

import dataclasses
import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rsjax.errors import UserError
from rsjax.files import disk_guard, write_atomically
from rsjax.progress import duration
from rsjax.tools.ingest.clips import CLIPS
from rsjax.tools.ingest.episode import EpisodeRef
from rsjax.tools.ingest.work_items import EpisodeWork, IngestPlan, ItemMark

QUARANTINE = "quarantine.jsonl"
SUMMARY = "summary.json"
WINDOWS = "windows.jsonl"
_ROW = ("episode", "stage", "key", "error", "option", "traceback")


@dataclass(frozen=True)
class IngestSummary:
    """The outcome of every episode (episodes = done + filtered + quarantined) and of every window.

    Attributes:
        episodes: how many the source lists.
        done: how many gave a clip.
        filtered: the reason by episode, for episodes that were read and gave no clip.
        quarantined: rows of the quarantine table: ``episode``, ``stage`` (the step), ``key``, ``error``, ``option``
            (the option that rules the episode out, or ""), ``traceback``.
        windows: how many were ``kept``, and how many were left out for each reason.
        steps: for each step, how many work items are done and failed, their seconds on a worker and on its cores, and
            the clips per second of one worker.
        fits: number of episodes by how their pictures, if not square, became square, in words.
        cut: number of episodes with more than one shot.
        test_clips: number of the store's test clips; None while it is not packed.
        depth_left_out: clips that lost their depth because its unit is not the store's.
        this_run: ``items`` (work items that were run), ``clips``, ``seconds`` and ``clips_per_second`` of the last
            run alone.
    """

    episodes: int
    done: int
    filtered: dict[str, str]
    quarantined: list[dict[str, Any]]
    windows: dict[str, int]
    steps: dict[str, dict[str, Any]]
    fits: dict[str, int]
    cut: int = 0
    test_clips: int | None = None
    depth_left_out: int = 0
    this_run: dict[str, float] | None = None

    def ruled_out_by(self) -> str:
        """Returns the one option that ruled out every quarantined episode; "" if there is none."""
        options = {row["option"] for row in self.quarantined}
        if len(options) == 1:
            return options.pop()
        return ""

    def tables(self) -> str:
        """Names the files that give the reasons for what was left out; "" if nothing was."""
        windows = sum(number for reason, number in self.windows.items() if reason != "kept")
        filled = {SUMMARY: self.filtered, QUARANTINE: self.quarantined, WINDOWS: windows}
        return " and ".join(name for name, rows in filled.items() if rows)


def summarise(
    plan: IngestPlan, refs: Sequence[EpisodeRef], refused: Sequence[tuple[EpisodeRef, str]] = ()
) -> IngestSummary:
    """Makes the summary from the marks of an ingest whose work items were all run.

    Args:
        refused: further episodes that are not in the store, and why.

    Raises:
        UserError: a work item has no mark.
    """
    filtered: dict[str, str] = {}
    short: dict[str, dict[str, Any]] = {}
    quarantined = [dict(zip(_ROW, (ref.id, "list", ref.fingerprint, why, "", ""), strict=True)) for ref, why in refused]
    windows = Counter({"kept": 0})
    fits = Counter[str]()
    steps: dict[str, dict[str, Any]] = {
        step.name: {"done": 0, "failed": 0, "seconds": 0.0, "cpu_seconds": 0.0} for step in plan.steps
    }
    done = 0
    clips = 0
    cut = 0
    for ref in refs:
        work = EpisodeWork(plan, ref)
        last = ItemMark()
        for step in plan.steps:
            mark = work.mark(step.name)
            if mark is None:
                raise UserError(f"{work.output(step.name)}: missing; the ingest is not finished, run it again")
            row = steps[step.name]
            row[mark["status"]] += 1
            row["seconds"] += mark["seconds"]
            row["cpu_seconds"] += mark["cpu_seconds"]
            last = mark
            cut += step.name == "shots" and mark.get("summary", {}).get("shots", 1) > 1
            if mark["status"] == "failed":
                quarantined.append({name: mark.get(name, "") for name in _ROW})
                break
        else:  # the last mark is that of cutting clips
            windows.update(last["summary"]["windows"])
            fits.update(filter(None, [last["summary"].get("fit")]))
            clips += last["records"]
            if last["records"]:
                done += 1
            elif left := _left_out(last["summary"]["windows"]):
                filtered[ref.id] = f"windows left out: {', '.join(left)}"
            else:
                short[ref.id] = last["summary"]["short"]
    for row in steps.values():
        if row["seconds"]:
            row["clips_per_second"] = clips / row["seconds"]
        else:
            row["clips_per_second"] = None
    # All episodes with the same cure get the same reason.
    longest = Counter[tuple[str, str]]()
    for why in short.values():
        cause = why["window"], why["cure"]
        longest[cause] = max(longest[cause], why["longest"])
    for name, why in short.items():
        most = longest[why["window"], why["cure"]]
        filtered[name] = f"shorter than a window ({why['window']}; the longest has {most}): {why['cure']}"
    return IngestSummary(len(refs) + len(refused), done, filtered, quarantined, dict(windows), steps, dict(fits), cut)


def _left_out(windows: dict[str, int]) -> list[str]:
    return [f"{number} {reason}" for reason, number in windows.items() if reason != "kept" and number]


def write_tables(plan: IngestPlan, refs: Sequence[EpisodeRef], summary: IngestSummary) -> None:
    """Writes the quarantine table, the windows that were left out (each a JSON object per line) and the summary."""
    with disk_guard(plan.folder):
        rows = "".join(f"{json.dumps(row)}\n" for row in summary.quarantined)
        write_atomically(plan.folder / QUARANTINE, rows.encode())
        counts = dataclasses.asdict(summary) | {"quarantined": len(summary.quarantined)}
        write_atomically(plan.folder / SUMMARY, json.dumps(counts, indent=1).encode())
        temporary = plan.folder / f"{WINDOWS}.{os.getpid()}.tmp"
        try:
            with temporary.open("w") as file:
                for ref in refs:
                    mark = EpisodeWork(plan, ref).done(CLIPS)
                    if mark is not None and mark["summary"]["left_out"]:
                        file.write(json.dumps({"episode": ref.id, "left_out": mark["summary"]["left_out"]}) + "\n")
            os.replace(temporary, plan.folder / WINDOWS)
        finally:
            temporary.unlink(missing_ok=True)


def no_clips(plan: IngestPlan, summary: IngestSummary) -> str:
    """Returns one line that says why no episode gave a clip."""
    option = summary.ruled_out_by()
    reasons = [row["error"] for row in summary.quarantined] + list(summary.filtered.values())
    if option:
        because = f", all {len(summary.quarantined)} of these because of {option}"
    else:
        because = ""
    return (
        f"none of {summary.episodes} episodes gave a clip ({len(summary.filtered)} left out, "
        f"{len(summary.quarantined)} quarantined{because}), the first one for: {reasons[0]}; {plan.folder} has all of "
        f"them in {summary.tables()}"
    )


def lines(summary: IngestSummary) -> list[str]:
    """Returns lines of text: episodes and windows, whose numbers add up, and each step's share of the time."""
    windows = summary.windows
    text = [
        f"episodes  {summary.episodes} = {summary.done} with clips + {len(summary.filtered)} without + "
        f"{len(summary.quarantined)} quarantined",
        " + ".join([f"windows   {sum(windows.values())} = {windows['kept']} kept", *_left_out(windows)]),
    ]
    if summary.cut:
        text.append(f"cuts      in {summary.cut} episodes, which no window crosses; --shots none if they are not cuts")
    if summary.test_clips == 0:
        # one episode is always for training
        cure = "raise --test-share"
        if summary.done < 2:
            cure = "add episodes"
        text.append(f"testing   no clip is left for it, and training needs two: {cure}")
    text += [f"pictures  of {number} episodes, {how}" for how, number in summary.fits.items()]
    if summary.depth_left_out:
        text.append(f"depth     left out of {summary.depth_left_out} clips: metres and relative depth do not mix")
    if (run := summary.this_run) is not None:
        text.append(
            f"this run  {run['items']} work items in {_brief(run['seconds'])}, {run['clips']} clips, "
            f"{run['clips_per_second']:.3g} clips/s"
        )
    for name, row in summary.steps.items():
        rate = ""
        if row["clips_per_second"]:
            rate = f", {row['clips_per_second']:.3g} clips/s a worker"
        text.append(
            f"{name:<9} {row['done']} done, {row['failed']} failed, {_brief(row['seconds'])} on workers, "
            f"{_brief(row['cpu_seconds'])} on cores{rate}"
        )
    reasons = Counter(summary.filtered.values()).most_common(3)
    text += [f"without   {number}×: {reason}" for reason, number in reasons]
    if option := summary.ruled_out_by():
        text.append(f"quarantined all {len(summary.quarantined)} because of {option}")
    text += [f"quarantined {row['episode']} at {row['stage']}: {row['error']}" for row in summary.quarantined[:3]]
    return text + ([f"… {len(summary.quarantined) - 3} more"] if len(summary.quarantined) > 3 else [])


def _brief(seconds: float) -> str:
    if seconds >= 60:
        return duration(seconds)
    return f"{seconds:.2g} s"
