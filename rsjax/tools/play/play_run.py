"""The run that sessions play: its model, clips, controls and simulator."""

import hashlib
import math
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.clip import Video
from rsjax.config import SimConfig, from_dict
from rsjax.data.clips import frame_rate
from rsjax.data.codec import Record
from rsjax.data.store import Source, Store, StoreError
from rsjax.devices import on_cpu
from rsjax.errors import UserError, first_line
from rsjax.evaluation.coverage import Coverage, read_coverage
from rsjax.files import FileError, read_json
from rsjax.models.trained import TrainedModel
from rsjax.tools.play.controls import Controls, controls_of_run
from rsjax.tools.play.messages import Refused
from rsjax.tools.policies.policy import Policy
from rsjax.tools.policies.run_data import RunData

SIMULATORS = {"robosuite/Lift": "robosuite", "metaworld/": "metaworld"}  # source of clips → package that simulates it
# Scores of the run's evaluation that say how far to trust what the page shows.
MEASURED = ("contact_false_success", "contact_false_failure", "contact_brier", "drive_gripper_error_widths")
FPS = 5.0  # for runs whose clips have no frame rate


@dataclass(frozen=True)
class PlayRun:
    """The data that all sessions share.

    Attributes:
        data: the run and where its clips are.
        split: the clips to begin with.
        policy: a policy that can act, or None.
        out: the directory of the files that viewers save.
    """

    data: RunData
    split: str = "test"
    policy: Policy | None = None
    out: Path = Path("play")

    @cached_property
    def trained(self) -> TrainedModel:
        return self.data.trained

    @cached_property
    def store(self) -> Store | None:
        """The run's clips; None if they are missing, so that sessions can begin only with uploaded pictures."""
        try:
            store = self.data.clips
            if self.split in store.splits:
                return store
            return None
        except UserError:
            return None

    @cached_property
    def missing(self) -> str:
        """The reason why there are no clips; "" if there are some."""
        try:
            store = self.data.clips
        except UserError as error:
            return first_line(error)
        if self.split in store.splits:
            return ""
        return f"{store.path}: has no split {self.split}"

    @cached_property
    def source(self) -> Source | None:
        if self.store is None:
            return None
        return self.store.source(self.split)

    @property
    def clips(self) -> int:
        """The number of clips to begin with."""
        if self.source is None:
            return 0
        return len(self.source)

    def clip(self, number: int) -> Record:
        """Returns a clip; raises :class:`Refused` if there is no clip with this number, or it is damaged."""
        if self.source is None or not 0 <= number < self.clips:
            if self.clips:
                has = f"has 0 to {self.clips - 1}"
            else:
                has = f"is missing: {self.missing}"
            raise Refused("no_clip", f"there is no clip {number}; the {self.split} split {has}")
        try:
            return self.source[number]
        except StoreError as error:
            raise Refused("no_clip", first_line(error)) from error

    @cached_property
    def has_depth(self) -> bool:
        """Whether the model generates depth."""
        model = self.trained
        return model.config.model.uses_depth and model.assets.normalization.depth_range is not None

    def first(self, clip: Record) -> Video:
        """Returns a clip's first frame, with depth if the model and the clip have it."""
        if self.has_depth and clip["depth"] is not None:
            depth = clip["depth"][None, :1]
        else:
            depth = None
        second = None
        if "second" in clip:
            second = clip["second"][None, :1]
        return Video(clip["rgb"][None, :1], depth, second=second)

    @cached_property
    def controls(self) -> Controls:
        if self.store:
            names = self.store.manifest.get("action_dimensions")
        else:
            names = None
        return controls_of_run(self.data.config, self.trained.assets.normalization, names or ())

    @property
    def fps(self) -> float:
        """Frames per second of the clips, from the first clip."""
        if self.store is not None:
            with suppress(Refused):  # the clip is damaged
                return frame_rate(self.clip(0), self.store.manifest) or FPS
        return FPS

    @cached_property
    def simulator(self) -> SimConfig | None:
        """The simulator that the clips are from; None for recordings, or if its package is not installed."""
        if self.store is None:
            return None
        source = str(self.store.manifest.get("source") or "")
        for beginning, package in SIMULATORS.items():
            if source.startswith(beginning) and find_spec(package) is not None:
                return from_dict(SimConfig, self.store.manifest["config"])
        return None

    @cached_property
    def measured(self) -> dict[str, float]:
        """The scores of :data:`MEASURED` that ``metrics.json`` has; empty before the run is finished."""
        with suppress(FileError):
            scores = read_json(self.data.run / "metrics.json")
            return {name: scores[name] for name in MEASURED if isinstance(scores.get(name), float)}
        return {}

    @cached_property
    def coverage(self) -> Coverage | None:
        """The bank that says how far frames are from the training clips; None if the run has not made it."""
        try:
            return read_coverage(self.trained, self.data.clips, self.data.run)
        except UserError:
            return None

    @cached_property
    def fingerprint(self) -> str:
        """A hash of the weights, 16 hexadecimal digits: a link works for runs with the same fingerprint."""
        digest = hashlib.sha256(repr(self.trained.config.model).encode())
        for leaf in jax.tree.leaves((self.trained.params, self.trained.assets.tokenizer)):
            digest.update(np.ascontiguousarray(leaf).tobytes())
        return digest.hexdigest()[:16]

    @property
    def bits(self) -> int:
        """The most entropy that a token can have."""
        return int(self.trained.config.tokenizer.code_bits)

    def describe(self) -> dict[str, Any]:
        """Returns the description of the run for a page."""
        config = self.data.config
        model = self.trained
        if self.has_depth:
            near_far = model.assets.normalization.depth_range
        else:
            near_far = None
        return {
            "name": self.data.run.absolute().name,
            "family": config.model.family,
            "preset": config.name,
            "fingerprint": self.fingerprint,
            "frames": config.clips.frames,
            "image_size": config.clips.image_size,
            "grid": config.grid,
            "has_depth": self.has_depth,
            "depth_range": list(near_far) if near_far else None,
            "fps": self.fps if math.isfinite(self.fps) else FPS,
            "split": self.split,
            "clips": self.clips,
            "missing": self.missing,
            "source": str(self.store.manifest.get("source") or "") if self.store else "",
            "measured": self.measured,
            "device": "cpu" if on_cpu() else jax.devices()[0].device_kind,
        }
