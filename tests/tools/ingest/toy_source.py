"""An in-memory data set of sound episodes, until a test changes one."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rsjax.tools.ingest.episode import Episode, EpisodeError, EpisodeRef, checked, fingerprint

COUNT = 12


@dataclass(frozen=True)
class Pictures:
    """As :class:`rsjax.tools.ingest.episode.Frames` and ``Depths``; reading one of ``broken`` fails."""

    array: np.ndarray
    broken: Sequence[int] = ()

    def __len__(self) -> int:
        return len(self.array)

    def read(self, indices: Sequence[int]) -> np.ndarray:
        if bad := set(indices) & set(self.broken):
            raise EpisodeError(f"a.mp4: frame {min(bad)} cannot be decoded")
        return self.array[list(indices)]


def pictures(seed: int, count: int = COUNT) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (count, 4, 4, 3), np.uint8)


def episode(seed: int, **changes: Any) -> Episode:
    """Two cameras, depth, 8 actions, and a state of three places and a quaternion."""
    rng = np.random.default_rng([seed, 1])
    turn = np.linspace(0, 0.5, COUNT)
    quaternion = np.stack([np.sin(turn), 0 * turn, 0 * turn, np.cos(turn)], 1)
    places = np.cumsum(rng.uniform(0.5, 1, (COUNT, 3)), axis=0)
    actions = rng.uniform(0.2, 1, (COUNT, 8))
    actions[0] = 0
    fresh = Episode(
        id=f"episode-{seed}",
        fingerprint=fingerprint((), seed),
        task="put it there",
        fps=5.0,
        timestamps=np.arange(COUNT) / 5,
        actions=actions.astype(np.float32),
        states=np.concatenate([places, quaternion], 1).astype(np.float32),
        cameras={"front": Pictures(pictures(seed)), "hand": Pictures(pictures(seed + 1000))},
        depth={"front": Pictures(np.ones((COUNT, 4, 4), np.float32))},
    )
    return replace(fresh, **changes)


@dataclass(frozen=True)
class ToySource:
    """As ``EpisodeSource``; an error in place of an episode is raised when it is read."""

    name = "toy"
    contents: tuple[Episode | Exception, ...]

    def episodes(self) -> Iterator[EpisodeRef]:
        for number, content in enumerate(self.contents):
            ref = EpisodeRef(f"episode-{number}", fingerprint((), number), {"number": number})
            yield replace(ref, id=content.id, fingerprint=content.fingerprint) if isinstance(content, Episode) else ref

    def read(self, ref: EpisodeRef) -> Episode:
        content = self.contents[ref.location["number"]]
        if isinstance(content, Exception):
            raise content
        return checked(content, content.id)


def source(*odd: Episode | Exception, fine: int = 6) -> ToySource:
    """``fine`` good episodes, then ``odd`` ones."""
    return ToySource((*(episode(seed) for seed in range(fine)), *odd))
