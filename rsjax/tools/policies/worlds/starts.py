"""First frames for episodes in a world model: from a run's held-out clips, or from the caller.

Axes: S×S pixels.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.config import Config
from rsjax.data.clips import readable
from rsjax.data.store import Source, StoreError
from rsjax.errors import UserError
from rsjax.models.trained import as_array, is_depth
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.run_clips import relocated
from rsjax.tools.policies.worlds.model_world import FirstFrame

MOST_DRAWS = 2**31


class StartError(UserError):
    """Says why an episode cannot begin: the run's clips are missing, or the given frame does not fit."""


@dataclass(frozen=True)
class Starts:
    """The first frames of a run's clips.

    Attributes:
        config: the run's configuration.
        run, data_dir, store: where its clips are, as for ``rsjax generate``.
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
            if self.store:
                config = relocated(self.config, self.store)
            else:
                config = self.config
            store = Run(config, self.run, self.data_dir).open_clips()
            if self.split not in store.splits:
                raise StoreError(f"{store.path}: has no split {self.split!r} ({', '.join(store.splits)})")
            return store.source(self.split)
        except UserError as error:
            if self.depth:
                frame = '"rgb": …, "depth": …'
            else:
                frame = '"rgb": …'
            raise StartError(
                f"{error}; without the run's clips, reset needs a first frame of its own: options={{{frame}}}; or name "
                f"them with data_dir or store"
            ) from error

    def choose(self, rng: np.random.Generator, options: dict[str, Any]) -> FirstFrame:
        """Returns the frame in the options, the first frame of the clip that they name, or that of a random clip.

        Args:
            rng: chooses the clip and the draws, where the options do not.
            options: "rgb", uint8 (S, S, 3), with "depth", metres (S, S), if the model generates it; or "clip", a
                number; or neither. "draw" determines the model's draws.

        Raises:
            StartError: the frame has another size or type, there is no such clip, or the clips are missing.
        """
        if not isinstance(options, Mapping):
            raise StartError(f"options are {options!r:.80}; give a dict with some of rgb, depth, clip and draw")
        if unknown := options.keys() - {"rgb", "depth", "clip", "draw"}:
            names = ", ".join(sorted(map(str, unknown)))
            raise StartError(f"reset has no option {names:.80} (options: rgb, depth, clip, draw)")
        draw = options.get("draw", 0)
        if not _is_whole(draw) or not 0 <= draw < MOST_DRAWS:
            raise StartError(f"the option draw is {draw!r:.80}; it is a whole number from 0 to {MOST_DRAWS - 1}")
        number = -1
        if "rgb" in options or "depth" in options:
            rgb, depth = self._checked(options)
        else:
            number, clip = self._clip(rng, options.get("clip"))
            rgb = clip["rgb"][0]
            if self.depth:
                depth = clip["depth"][0]
            else:
                depth = None
        drawn = rng.integers(MOST_DRAWS)  # also where the options say otherwise, so that later choices are the same
        return FirstFrame(rgb, depth, int(options.get("draw", drawn)), number)

    def _clip(self, rng: np.random.Generator, number: Any) -> tuple[int, dict[str, Any]]:
        """Returns the clip with this number, or a random one for None."""
        count = len(self.source)
        if number is None:
            for chosen, clip in readable(self.source, rng.permutation(count).tolist()):
                if not self.depth or clip["depth"] is not None:
                    return chosen, clip
            raise StartError(f"no clip of the {self.split} split has depth, which this model starts from")
        if not _is_whole(number) or not 0 <= number < count:
            raise StartError(f"no clip {number!r:.80} in the {self.split} split, which has 0 … {count - 1}")
        clip = self.source[int(number)]
        if self.depth and clip["depth"] is None:
            raise StartError(f"clip {number} of the {self.split} split has no depth, which this model starts from")
        return int(number), clip

    def _checked(self, options: dict[str, Any]) -> tuple[np.ndarray, np.ndarray | None]:
        """Returns the caller's frame and its depth."""
        size = self.config.clips.image_size
        rgb = as_array("the first frame's rgb", options.get("rgb"))
        if rgb.shape != (size, size, 3) or rgb.dtype != np.uint8:
            raise StartError(
                f"the first frame's rgb has shape {rgb.shape} and type {rgb.dtype}; expected ({size}, {size}, 3), "
                f"uint8, RGB from 0 to 255"
            )
        if not self.depth:
            return rgb, None
        depth = as_array("the first frame's depth", options.get("depth"))
        fits = depth.shape == (size, size) and depth.dtype.kind in "fiu"
        if not fits or not is_depth(depth) or np.isnan(depth).any():
            raise StartError(
                f"the first frame's depth has shape {depth.shape} and type {depth.dtype}; this model generates depth, "
                f"so it starts from finite floats of shape ({size}, {size}), 0 or more, metres along the optical axis"
            )
        return rgb, depth.astype(np.float32)


def _is_whole(value: Any) -> bool:
    """Returns whether a value is a whole number; True and False are not."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)
