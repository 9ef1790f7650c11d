"""Ingests a data set of any format into a store of clips: runs the steps on every episode, then packs their clips."""

import hashlib
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import cv2

from rsjax.config import content_key
from rsjax.data.store import MANIFEST, StoreError, open_store
from rsjax.files import disk_guard, making
from rsjax.processes import WorkerDied, count_cores, run_items
from rsjax.tools.ingest.clips import CLIPS
from rsjax.tools.ingest.episode import EpisodeRef
from rsjax.tools.ingest.packing import choose_contents, cut_episodes, pack, refuse_odd
from rsjax.tools.ingest.summary import IngestSummary, no_clips, summarise, write_tables
from rsjax.tools.ingest.work_items import EpisodeWork, IngestPlan, mark_path, run_episode

Settle = Callable[[EpisodeRef, int, int], None]  # takes an episode, how many work items were run, how many clips made
Progress = Callable[[int, int], None]  # takes (done, in all)
# Runs the work items that have no mark, on workers that may die, and calls Settle for every episode. Raises a UserError
# if no work item could be run, for example because the disk is full or a package is missing.
Runner = Callable[[IngestPlan, Sequence[EpisodeRef], Settle], None]


def run_on_this_machine(plan: IngestPlan, refs: Sequence[EpisodeRef], settle: Settle, workers: int = 0) -> None:
    """Runs the work items in this process, or in ``workers`` other processes. A :data:`Runner`."""

    def settled(ref: EpisodeRef, result: tuple[int, int] | WorkerDied) -> None:
        if isinstance(result, WorkerDied):
            work = EpisodeWork(plan, ref)
            failed = next(step.name for step in plan.steps if work.mark(step.name) is None)
            work.fail(failed, result)
            result = 1, 0
        settle(ref, *result)

    if workers:
        threads = max(1, count_cores() // workers)
    else:
        threads = None
    run_items(partial(_open_worker, plan, threads), refs, workers, settled)


def _open_worker(plan: IngestPlan, threads: int | None) -> Callable[[EpisodeRef], tuple[int, int]]:
    if threads is not None:
        limit_threads(threads)
    prepared: set[str] = set()
    return lambda ref: run_episode(plan, ref, prepared)


def ingest(
    plan: IngestPlan,
    run: Runner = run_on_this_machine,
    progress: Progress = lambda done, total: None,
    listed: tuple[list[EpisodeRef], list[EpisodeRef]] | None = None,
    *,
    keep_clips: bool = False,
    retry: bool = False,
) -> IngestSummary | None:
    """Runs the missing work items and packs the clips; the store appears complete or not at all.

    Args:
        progress: called with the number of steps done and that of :func:`count_steps`.
        listed: the result of :func:`list_episodes`, if it was called before.
        keep_clips: also keep the cut clips beside the store, which saves time when episodes are added.
        retry: run the quarantined episodes again.

    Returns:
        What became of every episode; None if the store is up to date.

    Raises:
        UserError: the source cannot be listed, nothing can be written, no episode gave a clip, another process is
            making the same store, or something else is in its place.
    """
    refs, duplicates = listed or list_episodes(plan)
    up_to_date = is_up_to_date(plan, refs)
    if up_to_date and not retry:
        return None
    with making(plan.out, wait=False):
        if retry and not _forget_failures(plan, refs) and up_to_date:
            return None
        this_run = _run(plan, refs, run, progress)
        return _pack(plan, refs, duplicates, this_run, progress, keep_clips)


def count_steps(plan: IngestPlan, refs: Sequence[EpisodeRef]) -> int:
    """Returns how many steps an ingest has, including the packing of each episode."""
    return len(refs) * (len(plan.steps) + 1)


def list_episodes(plan: IngestPlan) -> tuple[list[EpisodeRef], list[EpisodeRef]]:
    """Returns a source's episodes, and separately those that repeat the id of an earlier one.

    Raises:
        UserError: there are no episodes, or they cannot be listed.
    """
    refs: dict[str, EpisodeRef] = {}
    duplicates: list[EpisodeRef] = []
    for ref in plan.source.episodes():
        if refs.setdefault(ref.id, ref) is not ref:
            duplicates.append(ref)
    if not refs:
        raise StoreError(f"the {plan.source.name} data set has no episode; check the path")
    return list(refs.values()), duplicates


def is_up_to_date(plan: IngestPlan, refs: Sequence[EpisodeRef]) -> bool:
    """Returns whether the store exists and was made from the same episodes in the same way.

    Raises:
        StoreError: something else is in the store's place, which must not be replaced.
    """
    out = plan.out
    name = plan.source.name
    if out.exists() and not (out / MANIFEST).exists():
        raise StoreError(f"{out}: exists and is not a store; move it away or choose another --out")
    try:
        manifest = open_store(out).manifest
    except StoreError:  # missing or damaged
        return False
    ours = "counts" in manifest and manifest.get("source") == name  # stores that were merged or split have no counts
    if not ours or manifest.get("kind") != "clips":
        what = f"{manifest.get('kind')} of {manifest.get('source', 'another origin')}"
        raise StoreError(f"{out}: holds {what}, not what this makes of {name}; move it away or choose another --out")
    return manifest.get("asked") == _plan_key(plan, refs)


def _forget_failures(plan: IngestPlan, refs: Sequence[EpisodeRef]) -> int:
    """Removes the marks of failed work items, so that these are run again; returns how many there were."""
    failures = 0
    for work in (EpisodeWork(plan, ref) for ref in refs):
        for step in plan.steps:
            mark = work.mark(step.name)
            if mark is not None and mark["status"] == "failed":
                with disk_guard(plan.folder):
                    mark_path(work.output(step.name)).unlink()
                failures += 1
    return failures


def limit_threads(count: int) -> None:
    """Limits the threads of libraries, since workers share the cores. Call it before a network is loaded."""
    os.environ["OMP_NUM_THREADS"] = str(count)  # PyTorch
    cv2.setNumThreads(count)


def _run(plan: IngestPlan, refs: list[EpisodeRef], run: Runner, progress: Progress) -> dict[str, float]:
    """Runs the missing work items; returns ``this_run`` of :class:`IngestSummary`."""
    began = time.monotonic()
    episodes = 0
    items = 0
    clips = 0

    def settle(ref: EpisodeRef, ran: int, cut: int) -> None:
        nonlocal episodes, items, clips
        episodes = episodes + 1
        items = items + ran
        clips = clips + cut
        progress(episodes * len(plan.steps), count_steps(plan, refs))

    run(plan, refs, settle)
    seconds = time.monotonic() - began
    return {"items": items, "clips": clips, "seconds": seconds, "clips_per_second": clips / seconds}


def _pack(
    plan: IngestPlan,
    refs: list[EpisodeRef],
    duplicates: list[EpisodeRef],
    this_run: dict[str, float],
    progress: Progress,
    keep_clips: bool,
) -> IngestSummary:
    cuts, refused = refuse_odd(cut_episodes(plan, refs))
    odd = {ref.id for ref, _ in refused}
    refused += [(ref, f"id: another episode is called {ref.id} too; rename one") for ref in duplicates]
    contents = choose_contents(cuts, plan.shares)
    summary = replace(
        summarise(plan, [ref for ref in refs if ref.id not in odd], refused),
        test_clips=sum(cut.records for cut in contents.splits["test"]),
        depth_left_out=contents.depth_left_out(),
        this_run=this_run,
    )
    write_tables(plan, refs, summary)
    if not summary.done:
        raise StoreError(no_clips(plan, summary))
    steps = count_steps(plan, refs)
    plan_key = _plan_key(plan, refs)
    cut = [f"{cut.ref.id} {cut.records}" for cut in contents.episodes()]  # some episodes may have failed
    keys = {"asked": plan_key, "key": content_key(plan_key, contents.depth_unit, *cut)}
    pack(plan, contents, summary, keys, lambda packed: progress(steps - summary.done + packed, steps))
    for path in plan.items.rglob("*.tmp"):  # killed workers left these
        path.unlink(missing_ok=True)
    for path in () if keep_clips else (plan.items / CLIPS).rglob("*.array_record"):
        mark_path(path).unlink(missing_ok=True)
        path.unlink(missing_ok=True)
    return summary


def _plan_key(plan: IngestPlan, refs: Sequence[EpisodeRef]) -> str:
    """Returns a hash of the episodes and of how they become clips."""
    digest = hashlib.sha256()
    for ref in refs:
        digest.update(plan.keys(ref)[CLIPS].encode())
    return content_key("ingest", digest.hexdigest(), *plan.shares)
