"""Ingests of toy episodes, in this process."""

from pathlib import Path

from rsjax.ingest.annotators.categories import CategoryConfig
from rsjax.ingest.clips import ClipConfig
from rsjax.ingest.ingest import Plan, ingest
from rsjax.ingest.jobs.runner import Inline
from rsjax.ingest.jobs.work_items import Job
from rsjax.ingest.report import Counts
from rsjax.ingest.stages import Annotators, make_stages
from rsjax.ingest.windows import WindowConfig
from tests.ingest.toy import Source

CONFIG = ClipConfig(
    WindowConfig(frames=4, rate=2), image_size=8, tracks=6, categories=CategoryConfig((("pick*", "simple"),))
)
NOTHING = Annotators(shots=None, motion=None, tracks=None, semantics=None)


def plan(
    folder: Path,
    source: Source,
    annotators: Annotators = NOTHING,
    share: float = 0.25,
    config: ClipConfig = CONFIG,
) -> Plan:
    job = Job(source, "", make_stages(annotators, config), folder / "work")
    return Plan(job, folder / "store", share, {"config": {}})


def made(work: Plan, keep_clips: bool = False, retry: bool = False) -> Counts | None:
    counts = ingest(work, lambda: Inline(work.job), lambda done, total: None, keep_clips=keep_clips, retry=retry)
    if counts is not None:
        assert counts.found == counts.done + len(counts.filtered) + len(counts.quarantined)
    return counts
