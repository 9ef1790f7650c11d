"""A data set of any format into a store of clips: stages over its episodes, then one pass that packs what they left."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rsjax.config import content_key
from rsjax.data.store import MANIFEST, StoreError, open_store
from rsjax.files import disk_guard, lock
from rsjax.ingest.episode import EpisodeRef
from rsjax.ingest.jobs.runner import Executor, run
from rsjax.ingest.jobs.work_items import Job, Unit, mark_path
from rsjax.ingest.packing import CLIPS, Contents, choose_contents, cuts_of, fitting, pack
from rsjax.ingest.report import Counts, count, nothing, write_tables, write_windows

LOCK = "lock"
Found = tuple[list[EpisodeRef], list[EpisodeRef]]
Report = Callable[[int, int], None]


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

    def steps(self, refs: Sequence[EpisodeRef]) -> int:
        """How many units there are, and as many more as episodes are packed."""
        return len(refs) * (len(self.job.stages) + 1)


def ingest(
    plan: Plan,
    start: Callable[[], Executor],
    report: Report,
    found: Found | None = None,
    *,
    keep_clips: bool = False,
    retry: bool = False,
) -> Counts | None:
    """Does what is not done yet, and packs it; the store appears whole or not at all.

    Args:
        start: makes the workers, closed here.
        report: called with (steps finished, :meth:`Plan.steps`).
        found: what :func:`listed` gave, if that was asked before.
        keep_clips: keep the cut clips beside the store too, which saves time when episodes are added.
        retry: run what was quarantined again.

    Returns:
        What became of every episode; None where the store is there already, made of the same.

    Raises:
        UserError: the source cannot be listed, nothing can be written, no episode gave a clip, another process is at
            the same store, or the place holds something else.
    """
    refs, duplicates = found or listed(plan.job)
    made = is_made(plan, refs)
    if made and not retry:
        return None
    with lock(plan.job.folder / LOCK) as held:
        if not held:
            raise StoreError(f"{plan.out}: another process is making it; wait for that one or stop it")
        if retry and not forget_failures(plan.job, refs) and made:
            return None
        return _ingest(plan, start, report, refs, duplicates, keep_clips)


def is_made(plan: Plan, refs: Sequence[EpisodeRef]) -> bool:
    """Whether the store is there already, made of the same episodes in the same way.

    Raises:
        StoreError: something else is there, which is not to be replaced.
    """
    return _present(plan) == asked_key(plan, refs)


def _ingest(
    plan: Plan,
    start: Callable[[], Executor],
    report: Report,
    refs: list[EpisodeRef],
    duplicates: list[EpisodeRef],
    keep_clips: bool,
) -> Counts:
    steps = plan.steps(refs)
    executor = start()
    try:
        ran = run(plan.job, refs, executor, lambda done, _: report(done, steps))
    finally:
        executor.close()
    cuts, odd = fitting(cuts_of(plan.job, refs))
    refused = [(cut.ref, why) for cut, why in odd]
    refused += [(ref, f"id: another episode is called {ref.id} too; rename one") for ref in duplicates]
    unfit = {cut.ref.id for cut, _ in odd}
    counts = count(plan.job, [ref for ref in refs if ref.id not in unfit], refused)
    contents = choose_contents(cuts, plan.test_share)
    left_out = sum(cut.records for cut in contents.made() if cut.depth_unit not in (None, contents.depth_unit))
    counts = replace(counts, depth_left_out=left_out, ran=ran)
    write_tables(plan.job.folder, counts)
    write_windows(plan.job, refs)
    if not counts.done:
        raise StoreError(nothing(counts, plan.job.folder))
    pack(
        plan.job,
        plan.out,
        contents,
        counts,
        plan.meta | {"asked": asked_key(plan, refs), "key": store_key(plan, refs, contents)},
        lambda packed: report(steps - counts.done + packed, steps),
    )
    _clean(plan.job.folder / "units", keep_clips)
    return counts


def _present(plan: Plan) -> str | None:
    """What the store was asked for that is there already, if one is; errors as in :func:`is_made`."""
    out, name = plan.out, plan.job.source.name
    if out.exists() and not (out / MANIFEST).exists():
        raise StoreError(f"{out}: exists and is not a store; move it away or choose another --out")
    try:
        manifest = open_store(out).manifest
    except StoreError:  # nothing, or something damaged
        return None
    ours = "counts" in manifest and manifest.get("source") == name  # merging and splitting leave the counts out
    if not ours or manifest.get("kind") != "clips":
        what = f"{manifest.get('kind')} of {manifest.get('source', 'another origin')}"
        raise StoreError(f"{out}: holds {what}, not what this makes of {name}; move it away or choose another --out")
    return manifest.get("asked")


def _clean(units: Path, keep_clips: bool) -> None:
    """Deletes what killed workers left half written, and clips that are packed; marks of failures stay."""
    for path in units.rglob("*.tmp"):
        path.unlink(missing_ok=True)
    for path in () if keep_clips else (units / CLIPS).rglob("*.array_record"):
        mark_path(path).unlink(missing_ok=True)
        path.unlink(missing_ok=True)


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


def store_key(plan: Plan, refs: Sequence[EpisodeRef], contents: Contents) -> str:
    """The content key of a store: what was asked for, and which episodes gave how many clips, as some may fail."""
    made = [f"{cut.ref.id} {cut.records}" for cut in contents.made()]
    return content_key(asked_key(plan, refs), contents.depth_unit, *made)


def asked_key(plan: Plan, refs: Sequence[EpisodeRef]) -> str:
    """A hash of all that was asked for: the episodes, and how they are made into clips."""
    digest = hashlib.sha256()
    for ref in refs:
        digest.update(plan.job.keys(ref)[CLIPS].encode())
    return content_key("ingest", digest.hexdigest(), plan.test_share)
