"""Cut clips into one store: whose they are, in which split, in which unit of depth, and what the manifest says."""

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rsjax.data.codec import Record
from rsjax.data.normalization import Statistics
from rsjax.data.store import StoreError, open_store, write_store
from rsjax.ingest.clips import words
from rsjax.ingest.episode import EpisodeRef
from rsjax.ingest.jobs.work_items import Job, Unit
from rsjax.ingest.report import Counts

CLIPS = "clips"  # the last stage


class Cut(NamedTuple):
    """An episode whose clips were cut; the fields after ``records`` are those of its summary."""

    ref: EpisodeRef
    records: int
    action_dim: int | None
    success: int | None
    depth: list[float] | None
    depth_unit: str | None


@dataclass(frozen=True)
class Contents:
    """What goes into the store.

    Attributes:
        splits: the episodes of ``train`` and ``test`` that gave clips.
        depth_unit: that of most train clips with depth; None where there are none. Other clips' depth is left out.
        depth_range: of the train clips in that unit.
    """

    splits: dict[str, list[Cut]]
    depth_unit: str | None
    depth_range: list[float] | None

    def made(self) -> list[Cut]:
        """All episodes, by split."""
        return [cut for cuts in self.splits.values() for cut in cuts]


def split_episodes(refs: Sequence[EpisodeRef], test_share: float) -> dict[str, list[EpisodeRef]]:
    """``train`` and ``test``, in order; chosen by a hash of the ids, at least one each where there are two or more."""
    ranked = sorted(refs, key=lambda ref: hashlib.sha256(ref.id.encode("utf-8", "surrogatepass")).digest())
    held = min(len(refs) - 1, max(1, round(test_share * len(refs)))) if test_share > 0 else 0
    test = {ref.id for ref in ranked[:held]}
    return {"train": [r for r in refs if r.id not in test], "test": [r for r in refs if r.id in test]}


def cuts_of(job: Job, refs: Sequence[EpisodeRef]) -> Iterator[Cut]:
    """Of the episodes whose last stage is done."""
    for ref in refs:
        mark = job.mark(Unit(ref, CLIPS))
        if mark is not None and mark["status"] == "done":
            told = mark["summary"]
            yield Cut(ref, mark["records"], *(told[name] for name in Cut._fields[2:]))


def fitting(cuts: Iterator[Cut]) -> tuple[list[Cut], list[tuple[Cut, str]]]:
    """Those that gave clips with actions as long as most episodes' are, and those whose actions differ, with why."""
    made = [cut for cut in cuts if cut.records]
    widths = Counter(cut.action_dim for cut in made)
    usual = widths.most_common(1)[0][0] if widths else None
    why = f"dimensions, those of most others have {usual}; ingest it alone"
    odd = [(cut, f"actions: {cut.action_dim} {why}") for cut in made if cut.action_dim != usual]
    return [cut for cut in made if cut.action_dim == usual], odd


def choose_contents(made: Sequence[Cut], test_share: float) -> Contents:
    """Of the store of these episodes. Metres and relative depth do not mix: the unit of more train clips is taken."""
    by_id = {cut.ref.id: cut for cut in made}
    chosen = split_episodes([cut.ref for cut in made], test_share)
    splits = {split: [by_id[ref.id] for ref in refs] for split, refs in chosen.items()}
    units: Counter[str] = Counter()
    for cut in splits["train"]:
        if cut.depth_unit is not None:
            units[cut.depth_unit] += cut.records
    unit = max(units, key=lambda name: (units[name], name == "metres")) if units else None
    ranges = [cut.depth for cut in splits["train"] if cut.depth is not None and cut.depth_unit == unit]
    spread = [min(near for near, _ in ranges), max(far for _, far in ranges)] if ranges else None
    return Contents(splits, unit, spread)


def pack(
    job: Job, out: Path, contents: Contents, counts: Counts, meta: dict[str, Any], packed: Callable[[int], None]
) -> None:
    """Writes the store out of the clips that the units left.

    Its manifest has the train split's action statistics, unit and range of depth (None without depth), the episodes of
    each split, what was left out and why, and what every clip is called.

    Args:
        meta: more of the manifest.
        packed: called with the number of episodes that are packed.
    """
    made = contents.made()
    manifest = {
        "source": job.source.name,
        **_statistics(job, contents.splits["train"]),
        "depth_range": contents.depth_range,
        "depth_unit": contents.depth_unit,
        "episodes": {split: [cut.ref.id for cut in cuts] for split, cuts in contents.splits.items()},
        "success_share": _success_share(made),
        "counts": {
            "found": counts.found,
            "done": counts.done,
            "without": len(counts.filtered),
            "quarantined": len(counts.quarantined),
            "windows": counts.windows,
            "depth_left_out": counts.depth_left_out,
        },
        "filtered": counts.filtered,
        "quarantine": _reasons(counts),
    }
    done = iter(range(1, len(made) + 1))
    records = {
        split: _records(job, cuts, contents, lambda: packed(next(done))) for split, cuts in contents.splits.items()
    }
    write_store(out, "clips", records, manifest | {name: finite(value) for name, value in meta.items()}, words)
    open_store(out)


def finite(value: Any) -> Any:
    """The same, with null for numbers that JSON has not: infinity, where an option bounds nothing."""
    if isinstance(value, dict):
        return {name: finite(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _records(job: Job, cuts: Sequence[Cut], contents: Contents, packed: Callable[[], None]) -> Iterator[Record]:
    """The clips of these episodes, one at a time, in the store's unit of depth or without, and with its range."""
    for cut in cuts:
        source = job.records(Unit(cut.ref, CLIPS), {"records": cut.records})
        changes: dict[str, Any] = {} if cut.depth_unit == contents.depth_unit else {"depth": None}
        told = {"depth_range": contents.depth_range} | ({"depth_unit": ""} if changes else {})
        for number in range(len(source)):
            record = source[number]
            yield record | changes | {"provenance": record["provenance"] | told}
        packed()


def _success_share(made: Sequence[Cut]) -> float | None:
    """Of the clips of episodes that say whether they succeed; None where none does."""
    told = [cut for cut in made if cut.success is not None]
    return sum(cut.success or 0 for cut in told) / sum(cut.records for cut in told) if told else None


def _statistics(job: Job, cuts: Sequence[Cut]) -> dict[str, Any]:
    total: Statistics | None = None
    for cut in cuts:
        mark = job.mark(Unit(cut.ref, CLIPS))
        if mark is None:
            raise StoreError(f"{job.output(Unit(cut.ref, CLIPS))}: was deleted meanwhile; run again")
        rows = Statistics.from_json(mark["summary"]["actions"])
        total = total.merged(rows) if total else rows
    return total.to_json() if total else {}


def _reasons(counts: Counts) -> dict[str, str]:
    """Of the quarantined, by id, of which there may be several."""
    found: dict[str, str] = {}
    for row in counts.quarantined:
        told = f"{row['stage']}: {row['error']}"
        found[row["episode"]] = f"{found[row['episode']]}; {told}" if row["episode"] in found else told
    return found
