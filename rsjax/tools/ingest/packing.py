"""Packs cut clips into one store: chooses its episodes, their splits and the unit of depth, and writes the manifest."""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from rsjax.data.build import choose_test, clip_labels
from rsjax.data.codec import Record
from rsjax.data.normalization import Statistics
from rsjax.data.store import StoreError, open_store, write_store
from rsjax.tools.ingest.clips import CLIPS
from rsjax.tools.ingest.episode import EpisodeRef
from rsjax.tools.ingest.summary import IngestSummary
from rsjax.tools.ingest.work_items import EpisodeWork, IngestPlan, SplitShares


class CutEpisode(NamedTuple):
    """An episode whose clips were cut; the fields after ``records`` come from the summary of :func:`clips.cut`."""

    ref: EpisodeRef
    records: int
    action_dim: int | None
    success: int | None
    depth: list[float] | None
    depth_unit: str | None


@dataclass(frozen=True)
class Contents:
    """The contents of the store.

    Attributes:
        splits: the episodes of ``train``, ``test`` and perhaps ``validation``.
        depth_unit: the unit of most train clips with depth; None if there are none. Depth in another unit is left out.
        depth_range: depth range of the train clips in that unit.
    """

    splits: dict[str, list[CutEpisode]]
    depth_unit: str | None
    depth_range: list[float] | None

    def episodes(self) -> list[CutEpisode]:
        """Returns all episodes, by split."""
        return [cut for cuts in self.splits.values() for cut in cuts]

    def depth_left_out(self) -> int:
        """Counts the clips that lose their depth."""
        return sum(cut.records for cut in self.episodes() if cut.depth_unit not in (None, self.depth_unit))


def split_episodes(refs: Sequence[EpisodeRef], shares: SplitShares) -> dict[str, list[EpisodeRef]]:
    """Splits episodes into ``train``, ``test`` and, if it has a share, ``validation``, in order.

    If the source is a store with train and other splits, its clips stay in train or go to test, since several clips can
    show the same recording; the share of test is then ignored. Otherwise a hash of the ids decides: of two or more
    episodes each split gets at least one, but ``test`` is empty if its share is 0. ``validation`` is taken from what
    is not ``test``, and train keeps at least one. Episodes that a source calls clips of one recording stay together.
    """
    recordings = {ref.id: str(ref.location.get("recording", ref.id)) for ref in refs}
    names = list(dict.fromkeys(recordings.values()))
    test = {recordings[ref.id] for ref in refs if ref.location.get("split", "train") != "train"}
    if not 0 < len(test) < len(names):
        test = choose_test(names, shares.test, shares.seed)
    rest = [name for name in names if name not in test]
    chosen = {"test": test}
    if shares.validation:
        chosen["validation"] = choose_test(rest, shares.validation * len(names) / len(rest), shares.seed)
    others = set[str]().union(*chosen.values())
    splits = {"train": [ref for ref in refs if recordings[ref.id] not in others]}
    return splits | {split: [ref for ref in refs if recordings[ref.id] in some] for split, some in chosen.items()}


def cut_episodes(plan: IngestPlan, refs: Sequence[EpisodeRef]) -> list[CutEpisode]:
    """Returns the episodes that gave clips."""
    cuts = []
    for ref in refs:
        mark = EpisodeWork(plan, ref).done(CLIPS)
        if mark is not None and mark["records"]:
            cuts.append(CutEpisode(ref, mark["records"], *(mark["summary"][name] for name in CutEpisode._fields[2:])))
    return cuts


def refuse_odd(cuts: list[CutEpisode]) -> tuple[list[CutEpisode], list[tuple[EpisodeRef, str]]]:
    """Returns the episodes whose actions have the most common number of dimensions, and the others with the reason."""
    if not cuts:
        return [], []
    usual = Counter(cut.action_dim for cut in cuts).most_common(1)[0][0]
    why = f"dimensions, those of most others have {usual}; ingest it alone"
    odd = [(cut.ref, f"actions: {cut.action_dim} {why}") for cut in cuts if cut.action_dim != usual]
    return [cut for cut in cuts if cut.action_dim == usual], odd


def choose_contents(cuts: Sequence[CutEpisode], shares: SplitShares) -> Contents:
    """Splits the episodes and chooses the unit of depth, since one store cannot mix metres and relative depth."""
    by_id = {cut.ref.id: cut for cut in cuts}
    chosen = split_episodes([cut.ref for cut in cuts], shares)
    splits = {split: [by_id[ref.id] for ref in refs] for split, refs in chosen.items()}
    units: Counter[str] = Counter()
    for cut in splits["train"]:
        if cut.depth_unit is not None:
            units[cut.depth_unit] += cut.records
    unit = max(units, key=lambda name: (units[name], name == "metres"), default=None)
    ranges = [cut.depth for cut in splits["train"] if cut.depth is not None and cut.depth_unit == unit]
    spread = None
    if ranges:
        spread = [min(near for near, _ in ranges), max(far for _, far in ranges)]
    return Contents(splits, unit, spread)


def pack(
    plan: IngestPlan, contents: Contents, summary: IngestSummary, keys: dict[str, str], packed: Callable[[int], None]
) -> None:
    """Writes the store from the clips that were cut.

    Its manifest has the train split's action statistics, unit and range of depth (None without depth), the episodes of
    each split, what was left out and why, and every clip's labels.

    Args:
        keys: further entries of the manifest, in addition to those of the plan.
        packed: called with the number of episodes that are packed.
    """
    statistics: Statistics | None = None
    dimensions: Counter[tuple[str, ...]] = Counter()
    for cut in contents.splits["train"]:
        work = EpisodeWork(plan, cut.ref)
        mark = work.done(CLIPS)
        if mark is None:
            raise StoreError(f"{work.output(CLIPS)}: was deleted meanwhile; run again")
        rows = Statistics.from_json(mark["summary"]["actions"])
        statistics = statistics.merged(rows) if statistics else rows
        dimensions[tuple(mark["summary"]["dimensions"])] += 1
    episodes = contents.episodes()
    successes = [cut.success for cut in episodes if cut.success is not None]
    success_share = None
    if episodes and len(successes) == len(episodes):  # else no label would look like a failure
        success_share = sum(successes) / sum(cut.records for cut in episodes)
    quarantine: dict[str, str] = {}
    for row in summary.quarantined:  # several may share one id
        reason = f"{row['stage']}: {row['error']}"
        quarantine[row["episode"]] = "; ".join(filter(None, (quarantine.get(row["episode"]), reason)))
    manifest = {
        "source": plan.source.name,
        **(statistics.to_json() if statistics else {}),
        "action_dimensions": [line for lines, _ in dimensions.most_common(1) for line in lines],
        "depth_range": contents.depth_range,
        "depth_unit": contents.depth_unit,
        "episodes": {split: [cut.ref.id for cut in cuts] for split, cuts in contents.splits.items()},
        "success_share": success_share,
        "counts": {
            "found": summary.episodes,
            "done": summary.done,
            "without": len(summary.filtered),
            "quarantined": len(summary.quarantined),
            "windows": summary.windows,
            "depth_left_out": summary.depth_left_out,
        },
        "filtered": summary.filtered,
        "quarantine": quarantine,
    }
    done = iter(range(1, len(episodes) + 1))
    records = {
        split: _records(plan, cuts, contents, lambda: packed(next(done))) for split, cuts in contents.splits.items()
    }
    write_store(plan.out, "clips", records, manifest | _finite(plan.meta | keys), clip_labels)
    open_store(plan.out)


def _finite(value: Any) -> Any:
    """Replaces numbers that JSON lacks, such as infinity in an option without a bound, by null."""
    if isinstance(value, dict):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _records(
    plan: IngestPlan, cuts: Sequence[CutEpisode], contents: Contents, packed: Callable[[], None]
) -> Iterator[Record]:
    """Yields the clips of these episodes, without depth that is not in the store's unit, and with its depth range."""
    for cut in cuts:
        source = EpisodeWork(plan, cut.ref).records(CLIPS, cut.records)
        changes: dict[str, Any] = {}
        if cut.depth_unit != contents.depth_unit:
            changes["depth"] = None
        provenance = {"depth_range": contents.depth_range} | ({"depth_unit": ""} if changes else {})
        for number in range(len(source)):
            record = source[number]
            yield record | changes | {"provenance": record["provenance"] | provenance}
        packed()
