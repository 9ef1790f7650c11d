"""A data set of any format into a store of clips: stages over its episodes, then one pass that packs what they left."""

import hashlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsjax.annotate.clips import words
from rsjax.annotate.runner import QUARANTINE, SUMMARY, Counts, Executor, count, run, write_tables
from rsjax.annotate.units import Job, Mark, Unit, mark_path
from rsjax.config import content_key
from rsjax.data.actions import Statistics
from rsjax.data.codec import Record
from rsjax.data.episode import EpisodeRef
from rsjax.data.guard import open_foreign
from rsjax.data.store import StoreError, disk_guard, open_store, write_store

CLIPS = "clips"  # the last stage
Refused = list[tuple[EpisodeRef, str]]
Found = tuple[list[EpisodeRef], list[EpisodeRef]]


@dataclass(frozen=True)
class Plan:
    """What is ingested, and where it goes.

    Attributes:
        job: its last stage makes the clips; its folder is kept, so that other parameters reuse what they can.
        out: the store.
        test_share: of the episodes; all clips of an episode are in one split.
        meta: more of the manifest.
    """

    job: Job
    out: Path
    test_share: float
    meta: dict[str, Any]


def ingest(
    plan: Plan,
    start: Callable[[], Executor],
    report: Callable[[int, int], None],
    found: Found | None = None,
    *,
    keep_clips: bool = False,
    retry: bool = False,
) -> Counts | None:
    """Does what is not done yet, and packs it; the store appears whole or not at all.

    Args:
        start: makes the workers, closed here.
        report: called with (units finished, units in all).
        found: what :func:`listed` gave, if that was asked before.
        keep_clips: keep the cut clips beside the store too, which saves time when episodes are added.
        retry: run what was quarantined again.

    Returns:
        What became of every episode; None where the store is there already, made of the same.

    Raises:
        UserError: the source cannot be listed, nothing can be written, or no episode gave a clip.
    """
    refs, duplicates = found or listed(plan.job)
    key = store_key(plan, refs)
    again = retry and forget_failures(plan.job, refs)
    if not again and _present(plan.out) == key:
        return None
    executor = start()
    try:
        run(plan.job, refs, executor, report)
    finally:
        executor.close()
    fitting, refused = _fitting(plan.job, refs)
    refused += [(ref, f"id: another episode is called {ref.id} too; rename one") for ref in duplicates]
    counts = count(plan.job, fitting, refused)
    write_tables(plan.job.folder, counts)
    if not counts.done:
        reasons = [row["error"] for row in counts.quarantined] + list(counts.filtered.values())
        raise StoreError(
            f"none of {counts.found} episodes gave a clip ({len(counts.filtered)} left out, {len(counts.quarantined)} "
            f"not readable), the first one for: {reasons[0]}; {plan.job.folder} has all of them in {QUARANTINE} and "
            f"{SUMMARY}"
        )
    pack(plan, fitting, counts, key)
    if not keep_clips:
        shutil.rmtree(plan.job.folder / "units" / CLIPS, ignore_errors=True)
    return counts


def _present(out: Path) -> str | None:
    """The content key of the store that is there already, if one is."""
    try:
        return open_foreign(out).manifest.get("key")
    except StoreError:
        return None


def forget_failures(job: Job, refs: Sequence[EpisodeRef]) -> int:
    """Removes the marks of what is quarantined, so that it is run again; returns how many there were."""
    failures = 0
    for unit in (Unit(ref, stage.name) for ref in refs for stage in job.stages):
        mark = job.mark(unit)
        if mark is not None and mark["status"] == "failed":
            with disk_guard(job.folder):
                mark_path(job.output(unit)).unlink()
            failures += 1
    return failures


def listed(job: Job) -> Found:
    """A source's episodes, and those whose id another one has already."""
    seen: set[str] = set()
    refs: list[EpisodeRef] = []
    duplicates: list[EpisodeRef] = []
    for ref in job.source.episodes():
        (duplicates if ref.id in seen else refs).append(ref)
        seen.add(ref.id)
    if not refs:
        raise StoreError(f"the {job.source.name} data set has no episode; check the path")
    return refs, duplicates


def store_key(plan: Plan, refs: Sequence[EpisodeRef]) -> str:
    """The content key of the store that comes of these episodes."""
    digest = hashlib.sha256()
    for ref in refs:
        digest.update(plan.job.keys(ref)[CLIPS].encode())
    return content_key("ingest", digest.hexdigest(), plan.test_share)


def split_episodes(refs: Sequence[EpisodeRef], test_share: float) -> dict[str, list[EpisodeRef]]:
    """``train`` and ``test``, in order; chosen by a hash of the ids, at least one each where there are two or more."""
    ranked = sorted(refs, key=lambda ref: hashlib.sha256(ref.id.encode()).digest())
    held = min(len(refs) - 1, max(1, round(test_share * len(refs)))) if test_share > 0 else 0
    test = {ref.id for ref in ranked[:held]}
    return {"train": [r for r in refs if r.id not in test], "test": [r for r in refs if r.id in test]}


def pack(plan: Plan, refs: Sequence[EpisodeRef], counts: Counts, key: str) -> None:
    """Writes the store out of the clips that the units left.

    Its manifest has the train split's action statistics and depth range (None without depth), the episodes of each
    split, what was left out and why, and what every clip is called.
    """
    job = plan.job
    made = [ref for ref in refs if _done(job, ref)["records"]] if refs else []
    splits = split_episodes(made, plan.test_share)
    marks = [_done(job, ref)["summary"] for ref in splits["train"]]
    depth_range = _range([mark["depth"] for mark in marks if mark["depth"]])
    clips = sum(_done(job, ref)["records"] for ref in made)
    meta = {
        "key": key,
        "source": job.source.name,
        **_statistics(marks),
        "depth_range": depth_range,
        "episodes": {split: [ref.id for ref in chosen] for split, chosen in splits.items()},
        "success_share": sum(_done(job, ref)["summary"]["success"] for ref in made) / clips,
        "counts": {"found": counts.found, "done": counts.done, "windows": counts.windows},
        "filtered": counts.filtered,
        "quarantine": {row["episode"]: f"{row['stage']}: {row['error']}" for row in counts.quarantined},
    }
    records = {split: _records(job, chosen, depth_range) for split, chosen in splits.items()}
    write_store(plan.out, "clips", records, meta | plan.meta, words)
    open_store(plan.out)


def _records(job: Job, refs: Sequence[EpisodeRef], depth_range: list[float] | None) -> Iterator[Record]:
    """The clips of these episodes, one at a time, with the depth range in their provenance."""
    for ref in refs:
        unit = Unit(ref, CLIPS)
        source = job.records(unit, _done(job, ref))
        for number in range(len(source)):
            record = source[number]
            yield record | {"provenance": record["provenance"] | {"depth_range": depth_range}}


def _done(job: Job, ref: EpisodeRef) -> Mark:
    mark = job.mark(Unit(ref, CLIPS))
    if mark is None or mark["status"] != "done":
        return {"records": 0}
    return mark


def _fitting(job: Job, refs: Sequence[EpisodeRef]) -> tuple[list[EpisodeRef], Refused]:
    """The episodes whose actions are as long as those of the first that has any, and the others."""
    fitting: list[EpisodeRef] = []
    refused: Refused = []
    width: int | None = None
    for ref in refs:
        there = _done(job, ref).get("summary", {}).get("action_dim")
        width = width or there
        if there in (None, width):
            fitting.append(ref)
        else:
            refused.append((ref, f"actions: {there} dimensions, those of the others have {width}; ingest it alone"))
    return fitting, refused


def _statistics(summaries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    total: Statistics | None = None
    for summary in summaries:
        rows = Statistics.from_json(summary["actions"])
        total = total.merged(rows) if total else rows
    return total.to_json() if total else {}


def _range(ranges: Sequence[list[float]]) -> list[float] | None:
    return [min(near for near, _ in ranges), max(far for _, far in ranges)] if ranges else None
