"""Checks a whole data set, and lists the episodes that should be left out.

Each episode is checked by itself (:mod:`rsjax.tools.ingest.checks`) and then compared with the others by its statistics
alone, so that memory does not depend on the pictures.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from rsjax.data.store import MANIFEST
from rsjax.errors import did_you_mean
from rsjax.processes import WorkerDied, run_items
from rsjax.tools.ingest.checks import KINDS, EpisodeStats, Finding, Thresholds, check_episode
from rsjax.tools.ingest.episode import Episode, EpisodeError, EpisodeRef, EpisodeSource, SourceError
from rsjax.tools.ingest.formats import FORMATS, open_source

FEWEST = 5  # with fewer episodes, they are not compared with what is usual

Checked = tuple[EpisodeRef, list[Finding], EpisodeStats | None, str]  # the last: what the reader repaired


@dataclass(frozen=True)
class Diagnosis:
    """The result of checking a data set.

    Attributes:
        refs: every episode's id and fingerprint, in order.
        findings: in the order of the episodes.
        mended: id and notes of each episode in which the reader repaired something.
        unread: ids of the episodes that could not be read or checked.
    """

    refs: tuple[tuple[str, str], ...]
    findings: tuple[Finding, ...]
    mended: tuple[tuple[str, str], ...] = ()
    unread: frozenset[str] = frozenset()

    def counts(self) -> dict[str, int]:
        """Counts the episodes that have each kind of finding, in the order of :data:`KINDS`."""
        episodes = Counter(name for name, _ in self.refs)  # several may share one id
        affected: Counter[str] = Counter()
        for name, kind in {(finding.episode, finding.kind) for finding in self.findings}:
            affected[kind] += episodes[name]
        return {kind: affected[kind] for kind in KINDS if affected[kind]}

    def usual(self) -> list[str]:
        """Returns the kinds of finding that every episode has, if all can be read and decoded: they may be intended."""
        kinds = {} if self.unread else self.counts()
        return [kind for kind, count in kinds.items() if count == len(self.refs) and kind != "undecodable"]

    def reasons(self) -> dict[str, list[str]]:
        """Returns the findings of each episode that has any, as texts by its id."""
        reasons: dict[str, list[str]] = {}
        for finding in self.findings:
            reasons.setdefault(finding.episode, []).append(f"{finding.kind}: {finding.detail}")
        return reasons


def open_any(what: str, path: Path | None, **options: object) -> EpisodeSource:
    """Opens the ``STORE`` or the ``FORMAT PATH`` of a command line.

    Args:
        what: a store's directory, or a format's name.
        path: the data set's path, if ``what`` is a format.
        options: options of the format.

    Raises:
        SourceError: ``what`` is neither.
    """
    if path is not None:
        return open_source(what, path, **options)
    if what in FORMATS:
        raise SourceError(f"{what} is a format; say where the data set is: {what} PATH")
    if not (Path(what) / MANIFEST).exists():
        raise SourceError(
            f"{what}: no store (it has no {MANIFEST}){did_you_mean(what, FORMATS)}; "
            f"name a store, or a format and a path: {', '.join(FORMATS)}"
        )
    return open_source("sim", what, **options)


def diagnose(
    source: EpisodeSource,
    limits: Thresholds,
    ignored: Sequence[str] = (),
    progress: Callable[[int], None] = lambda done: None,
    workers: int = 1,
) -> Diagnosis:
    """Checks every episode of a data set.

    Args:
        limits: limits of the checks.
        ignored: kinds of findings to leave out.
        progress: called with the number of episodes done.
        workers: number of processes; 1: only this one.

    Raises:
        SourceError: the data set cannot be listed or is empty, or an ignored kind does not exist.
    """
    for kind in ignored:
        if kind not in KINDS:
            raise SourceError(f"no kind {kind!r} to ignore{did_you_mean(kind, KINDS)}; there are {', '.join(KINDS)}")
    refs: list[tuple[str, str]] = []
    findings: dict[str, list[Finding]] = {}  # by episode, in their order
    stats: dict[str, EpisodeStats] = {}
    mended: list[tuple[str, str]] = []
    unread = set[str]()
    for ref, problems, own, notes in _check_all(source, limits, workers, progress):
        if ref.id in findings:
            findings[ref.id].append(Finding(ref.id, "duplicate", "another episode has the same id"))
        findings.setdefault(ref.id, []).extend(problems)
        if own is not None:
            stats.setdefault(ref.id, own)
        else:
            unread.add(ref.id)
        if notes:
            mended.append((ref.id, notes))
        refs.append((ref.id, ref.fingerprint))
    if not refs:
        raise SourceError(f"{source.name}: the data set has no episodes; check the path and the options")
    for finding in compare(stats, limits.unusual):
        findings[finding.episode].append(finding)
    kept = (finding for one in findings.values() for finding in one if finding.kind not in ignored)
    return Diagnosis(tuple(refs), tuple(kept), tuple(mended), frozenset(unread))


def _check_all(
    source: EpisodeSource, limits: Thresholds, workers: int, progress: Callable[[int], None]
) -> list[Checked]:
    """Checks every episode and returns the results in the order of the episodes."""
    checked: dict[int, Checked] = {}

    def settle(numbered: tuple[int, EpisodeRef], result: Checked | WorkerDied) -> None:
        number, ref = numbered
        if isinstance(result, WorkerDied):
            result = ref, [Finding(ref.id, "unreadable", str(result))], None, ""
        checked[number] = result
        progress(len(checked))

    numbered = enumerate(source.episodes())
    run_items(partial(_open_check, source, limits), numbered, workers if workers > 1 else 0, settle)
    return [checked[number] for number in range(len(checked))]


def _open_check(source: EpisodeSource, limits: Thresholds) -> Callable[[tuple[int, EpisodeRef]], Checked]:
    return lambda numbered: _check(source, limits, numbered[1])


def _check(source: EpisodeSource, limits: Thresholds, ref: EpisodeRef) -> Checked:
    try:
        episode = source.read(ref)
        return ref, *check_episode(episode, limits), _mended(episode)
    except Exception as error:  # an error in one episode must not hide the others
        line = " ".join(str(error).split())
        kind, detail = ("unreadable", f"{type(error).__name__}: {line}")
        if isinstance(error, EpisodeError):
            kind, detail = error.kind, line
        return ref, [Finding(ref.id, kind, detail)], None, ""


def _mended(episode: Episode) -> str:
    """Returns the reader's notes on what it repaired."""
    notes = []
    for name, value in episode.meta.get("notes", {}).items():
        parts = [f"{key} {number}" for key, number in value.items()] if isinstance(value, dict) else value
        notes.append(f"{name.replace('_', ' ')}: {', '.join(map(str, parts)) if isinstance(parts, list) else parts}")
    return "; ".join(notes)


def compare(stats: dict[str, EpisodeStats], unusual: float) -> Iterator[Finding]:
    """Yields findings on episodes that differ from the others or duplicate another one.

    Args:
        stats: each episode's statistics by its id.
        unusual: as in :class:`Thresholds`.
    """
    seen: dict[bytes, str] = {}
    for name, own in stats.items():
        if own.digest is not None and (first := seen.setdefault(own.digest, name)) != name:
            yield Finding(name, "duplicate", f"its actions, states and first picture are those of {first}")
    if len(stats) < FEWEST:
        return
    usual = Counter(camera for own in stats.values() for camera in own.cameras)
    wanted = {camera for camera, count in usual.items() if count > len(stats) / 2}
    for name, own in stats.items():
        if lacking := sorted(wanted - set(own.cameras)):
            yield Finding(name, "camera", f"has no {', '.join(lacking)}, which most episodes have")
    yield from _outliers("action", {name: own.reach for name, own in stats.items()}, "reaches", unusual)
    yield from _outliers("state", {name: own.jump for name, own in stats.items()}, "jumps by", unusual)


def _outliers(kind: str, figures: dict[str, Float32[np.ndarray, " n"]], verb: str, unusual: float) -> Iterator[Finding]:
    """Yields findings on episodes whose figures differ in length from most, or are far above the median."""
    width = Counter(len(figure) for figure in figures.values()).most_common(1)[0][0]
    alike = {name: figure for name, figure in figures.items() if len(figure) == width}
    for name, figure in figures.items():
        if name not in alike:
            yield Finding(name, kind, f"has {len(figure)} dimensions, most episodes have {width}")
    middle = np.median(np.stack(list(alike.values())), axis=0)
    for name, figure in alike.items():
        times = np.divide(figure, middle, out=np.zeros(width), where=middle > 0)
        if width and times.max() > unusual:
            worst = int(times.argmax())
            yield Finding(
                name, kind, f"dimension {worst} {verb} {figure[worst]:.4g}, {times[worst]:.0f} times the usual"
            )
