"""Goes through a data set, finds what is wrong where, and lists the episodes that are better left out.

Each episode is looked at by itself (:mod:`rsjax.ingest.checks`) and then against the others. What is kept of an episode
meanwhile is some hundred bytes, whatever its pictures weigh.
"""

import multiprocessing
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from rsjax.data.store import MANIFEST
from rsjax.errors import did_you_mean
from rsjax.ingest.checks import KINDS, Finding, Thresholds, Vitals, look_at
from rsjax.ingest.episode import Episode, EpisodeError, EpisodeRef, EpisodeSource, SourceError
from rsjax.ingest.formats import FORMATS, open_source

FEWEST = 5  # episodes from which on there is something usual
_CHUNK = 8  # episodes that a process is given at a time

Look = tuple[EpisodeRef, list[Finding], Vitals | None, str]


@dataclass(frozen=True)
class Report:
    """What a look at a data set found.

    Attributes:
        refs: every episode's id and fingerprint, in order.
        findings: in the order of the episodes.
        mended: of episodes in which the reader put something right: (id, what).
    """

    refs: tuple[tuple[str, str], ...]
    findings: tuple[Finding, ...]
    mended: tuple[tuple[str, str], ...] = ()

    def counts(self) -> dict[str, int]:
        """How many episodes have each kind of finding, in the order of :data:`KINDS`."""
        episodes = Counter(name for name, _ in self.refs)  # several may have one id
        affected: Counter[str] = Counter()
        for name, kind in {(finding.episode, finding.kind) for finding in self.findings}:
            affected[kind] += episodes[name]
        return {kind: affected[kind] for kind in KINDS if affected[kind]}

    def bad(self) -> int:
        """How many episodes have a finding."""
        affected = {finding.episode for finding in self.findings}
        return sum(name in affected for name, _ in self.refs)

    def reasons(self) -> dict[str, list[str]]:
        """What is wrong with each episode that has something wrong, by its id."""
        told: dict[str, list[str]] = {}
        for finding in self.findings:
            told.setdefault(finding.episode, []).append(f"{finding.kind}: {finding.detail}")
        return told


def open_any(what: str, path: Path | None, **options: object) -> EpisodeSource:
    """What a user means by ``STORE`` or by ``SOURCE PATH``.

    Args:
        what: a store's directory, or a format's name.
        path: of the data set, with a format.
        options: of the format.

    Raises:
        SourceError: it is neither.
    """
    if path is not None:
        return open_source(what, path, **options)
    if what in FORMATS:
        raise SourceError(f"{what} is a format; say where the data set is: {what} PATH")
    if not (Path(what) / MANIFEST).exists():
        raise SourceError(
            f"{what}: no store (it has no {MANIFEST}){did_you_mean(what, FORMATS)}; "
            f"give a store, or a format and a path: {', '.join(FORMATS)}"
        )
    return open_source("sim", what, **options)


def examine(
    source: EpisodeSource,
    limits: Thresholds,
    ignored: Sequence[str] = (),
    report: Callable[[int], None] = lambda done: None,
    workers: int = 1,
) -> Report:
    """Looks at every episode of a data set.

    Args:
        limits: from where on something is wrong.
        ignored: kinds that are not told.
        report: called with the number of episodes done.
        workers: processes; 1: this one.

    Raises:
        SourceError: the data set cannot be listed, an ignored kind does not exist, or a process died.
    """
    for kind in ignored:
        if kind not in KINDS:
            raise SourceError(f"no kind {kind!r} to ignore{did_you_mean(kind, KINDS)}; there are {', '.join(KINDS)}")
    refs: list[tuple[str, str]] = []
    findings: list[Finding] = []
    vitals: dict[str, Vitals] = {}
    known: set[str] = set()
    mended: list[tuple[str, str]] = []
    for ref, told, seen, notes in _looks(source, limits, workers):
        if ref.id in known:
            findings.append(Finding(ref.id, "duplicate", "another episode has the same id"))
        known.add(ref.id)
        findings += told
        if seen is not None:
            vitals.setdefault(ref.id, seen)
        if notes:
            mended.append((ref.id, notes))
        refs.append((ref.id, ref.fingerprint))
        report(len(refs))
    if not refs:
        raise SourceError(f"{source.name}: the data set has no episodes; check the path and the options")
    findings += compare(vitals, limits.unusual)
    place = {ref: number for number, (ref, _) in enumerate(refs)}
    findings = [finding for finding in findings if finding.kind not in ignored]
    return Report(tuple(refs), tuple(sorted(findings, key=lambda finding: place[finding.episode])), tuple(mended))


def _looks(source: EpisodeSource, limits: Thresholds, workers: int) -> Iterator[Look]:
    if workers <= 1:
        yield from map(partial(_look, source, limits), source.episodes())
        return
    done = 0
    context = multiprocessing.get_context("spawn")  # the readers' libraries have threads, which a fork would break
    try:
        with ProcessPoolExecutor(workers, mp_context=context) as pool:
            for look in pool.map(partial(_look, source, limits), source.episodes(), chunksize=_CHUNK):
                yield look
                done += 1
    except BrokenProcessPool as error:
        raise SourceError(
            f"{source.name}: a process died after {done} episodes, for lack of memory or in a library; run again with "
            f"fewer workers (now {workers})"
        ) from error


def _look(source: EpisodeSource, limits: Thresholds, ref: EpisodeRef) -> Look:
    try:
        episode = source.read(ref)
        return ref, *look_at(episode, limits), _mended(episode)
    except EpisodeError as error:
        return ref, [Finding(ref.id, error.kind, _line(error))], None, ""
    except Exception as error:  # a surprise about one episode must not hide what is wrong with the others
        return ref, [Finding(ref.id, "unreadable", f"{type(error).__name__}: {_line(error)}")], None, ""


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


def _mended(episode: Episode) -> str:
    """What the episode's reader noted that it put right."""
    told = []
    for name, value in episode.meta.get("notes", {}).items():
        parts = [f"{key} {number}" for key, number in value.items()] if isinstance(value, dict) else value
        told.append(f"{name.replace('_', ' ')}: {', '.join(map(str, parts)) if isinstance(parts, list) else parts}")
    return "; ".join(told)


def compare(vitals: dict[str, Vitals], unusual: float) -> Iterator[Finding]:
    """What is wrong with episodes that differ from the others, and with those that do not differ at all.

    Args:
        vitals: of each episode by its id.
        unusual: as in :class:`Thresholds`.
    """
    seen: dict[bytes, str] = {}
    for name, own in vitals.items():
        if own.digest is not None and (first := seen.setdefault(own.digest, name)) != name:
            yield Finding(name, "duplicate", f"its actions, states and first picture are those of {first}")
    if len(vitals) < FEWEST:
        return
    usual = Counter(camera for own in vitals.values() for camera in own.cameras)
    wanted = {camera for camera, count in usual.items() if count > len(vitals) / 2}
    for name, own in vitals.items():
        if lacking := sorted(wanted - set(own.cameras)):
            yield Finding(name, "camera", f"has no {', '.join(lacking)}, which most episodes have")
    yield from _beyond("action", {name: own.reach for name, own in vitals.items()}, "reaches", unusual)
    yield from _beyond("state", {name: own.jump for name, own in vitals.items()}, "jumps by", unusual)


def _beyond(kind: str, figures: dict[str, Float32[np.ndarray, " n"]], verb: str, unusual: float) -> Iterator[Finding]:
    """Episodes whose figures have another length than most, or are far above the median."""
    width = Counter(len(figure) for figure in figures.values()).most_common(1)[0][0]
    alike = {name: figure for name, figure in figures.items() if len(figure) == width}
    for name, figure in figures.items():
        if name not in alike:
            yield Finding(name, kind, f"has {len(figure)} dimensions, most episodes have {width}")
    middle = np.median(np.stack(list(alike.values())), axis=0) if alike else np.zeros(width)
    for name, figure in alike.items():
        times = np.divide(figure, middle, out=np.zeros(width), where=middle > 0)
        if width and times.max() > unusual:
            worst = int(times.argmax())
            yield Finding(
                name, kind, f"dimension {worst} {verb} {figure[worst]:.4g}, {times[worst]:.0f} times the usual"
            )
