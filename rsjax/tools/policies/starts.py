"""First frames for episodes in a world model: from a run's held-out clips, or from the caller.

Axes: N episodes, S×S pixels.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.clip import Video
from rsjax.config import Config
from rsjax.data.clips import readable
from rsjax.data.store import Source, StoreError
from rsjax.errors import UserError
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.run_clips import relocated


class StartError(UserError):
    """Says why an episode cannot begin: the run's clips are missing, or the given frame does not fit."""


@dataclass(frozen=True)
class Start:
    """Where an episode begins.

    Attributes:
        video: the first frame, (1, 1, S, S, …).
        clip: the clip's number in its split; -1 for a given frame.
    """

    video: Video
    clip: int


@dataclass(frozen=True)
class Starts:
    """The first frames of a run's clips.

    Attributes:
        config: the run's configuration.
        run, data_dir, store: where its clips are, as for ``experiments.generate``.
        split: the clips to choose from.
        depth: whether a first frame needs depth.
    """

    config: Config
    run: Path
    data_dir: Path
    store: Path | None
    split: str
    depth: bool

    @cached_property
    def source(self) -> Source:
        """The clips of the split.

        Raises:
            StartError: the clips are missing.
        """
        try:
            config = relocated(self.config, self.store) if self.store else self.config
            store = Run(config, self.run, self.data_dir).open_clips()
            if self.split not in store.splits:
                raise StoreError(f"{store.path}: has no split {self.split!r} ({', '.join(store.splits)})")
            return store.source(self.split)
        except UserError as error:
            frame = '"rgb": …, "depth": …' if self.depth else '"rgb": …'
            raise StartError(
                f"{error}; without the run's clips, reset needs a first frame of its own: options={{{frame}}}; or name "
                f"them with data_dir or store"
            ) from error

    def choose(self, rng: np.random.Generator, options: dict[str, Any]) -> Start:
        """Returns the frame in the options, the first frame of the clip that they name, or that of a random clip.

        Args:
            options: "rgb", uint8 (S, S, 3), with "depth", metres (S, S), if the model generates it; or "clip", a
                number; or neither.

        Raises:
            StartError: the frame has another size or type, there is no such clip, or the clips are missing.
        """
        if unknown := options.keys() - {"rgb", "depth", "clip", "draw"}:
            raise StartError(f"reset has no option {', '.join(sorted(unknown))} (options: rgb, depth, clip, draw)")
        if "rgb" in options or "depth" in options:
            return Start(self._given(options), -1)
        count = len(self.source)
        number = options.get("clip")
        if number is None:
            return self._any(rng)
        if not isinstance(number, int | np.integer) or not 0 <= number < count:
            raise StartError(f"no clip {number!r} in the {self.split} split, which has 0 … {count - 1}")
        clip = self.source[int(number)]
        if self.depth and clip["depth"] is None:
            raise StartError(f"clip {number} of the {self.split} split has no depth, which this model starts from")
        return Start(self._first(clip), int(number))

    def _any(self, rng: np.random.Generator) -> Start:
        for number, clip in readable(self.source, rng.permutation(len(self.source)).tolist()):
            if not self.depth or clip["depth"] is not None:
                return Start(self._first(clip), number)
        raise StartError(f"no clip of the {self.split} split has depth, which this model starts from")

    def _first(self, clip: dict[str, Any]) -> Video:
        return Video(clip["rgb"][None, :1], clip["depth"][None, :1] if self.depth else None)

    def _given(self, options: dict[str, Any]) -> Video:
        size = self.config.clips.image_size
        rgb = np.asarray(options.get("rgb"))
        if rgb.shape != (size, size, 3) or rgb.dtype != np.uint8:
            raise StartError(
                f"the first frame's rgb has shape {rgb.shape} and type {rgb.dtype}; expected ({size}, {size}, 3), "
                f"uint8, RGB from 0 to 255"
            )
        if not self.depth:
            return Video(rgb[None, None])
        depth = np.asarray(options.get("depth"))
        if depth.shape != (size, size) or depth.dtype.kind not in "fiu" or not np.isfinite(depth).all():
            raise StartError(
                f"the first frame's depth has shape {depth.shape} and type {depth.dtype}; this model generates depth, "
                f"so it starts from finite floats of shape ({size}, {size}), metres along the optical axis"
            )
        return Video(rgb[None, None], depth.astype(np.float32)[None, None])
