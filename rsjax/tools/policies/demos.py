"""Demonstrations: the clips that a policy learns from.

Axes: T frames, S×S pixels, k controls between two frames, D numbers of a control, A = k·D of an action.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from rsjax.data.clips import readable
from rsjax.data.codec import Record
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.progress import note
from rsjax.tools.policies.diffusion_policy import Range
from rsjax.tools.sim.episode import begins_episode

Only = Literal["success", "all"]


@dataclass(frozen=True)
class Demos:
    """Demonstrations in memory, as a source of records with ``rgb`` (T, S, S, 3) and ``actions`` (T, A).

    Attributes:
        records: the demonstrations.
        controls: k.
    """

    records: tuple[Record, ...]
    controls: int

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, index: int) -> Record:
        return self.records[index]

    @property
    def image_size(self) -> int:
        return int(self.records[0]["rgb"].shape[1])

    @property
    def width(self) -> int:
        """D."""
        return int(self.records[0]["actions"].shape[1]) // self.controls

    @property
    def range(self) -> Range:
        """The range of the controls."""
        return Range.of(np.concatenate([record["actions"][1:].reshape(-1, self.width) for record in self.records]))

    def first(self, count: int) -> "Demos":
        """Returns the first ``count`` demonstrations.

        Raises:
            UserError: there are fewer, or ``count`` is below 1.
        """
        if count < 1:
            raise UserError(f"{count} demonstrations are asked for; it takes 1 at least")
        if count > len(self):
            raise UserError(f"{count} demonstrations are asked for, there are {len(self)}; make more, or ask for fewer")
        return Demos(self.records[:count], self.controls)

    def __add__(self, other: "Demos") -> "Demos":
        """Joins demonstrations of equal sizes.

        Raises:
            UserError: they differ in pixels, controls per action or numbers of a control.
        """
        kinds = [(each.image_size, each.controls, each.width) for each in (self, other)]
        if kinds[0] != kinds[1]:
            raise UserError(f"demonstrations of (pixels, controls, numbers) {kinds[0]} and {kinds[1]} cannot be mixed")
        return Demos((*self.records, *other.records), self.controls)


def load_demos(store: Store, splits: Sequence[str], only: Only = "success", seed: int = 0) -> Demos:
    """Reads a store's clips as demonstrations, in an order that depends on the seed alone.

    Args:
        only: which clips, as of :func:`is_demo`.

    Raises:
        UserError: the store has no such clip.
    """
    labelled = chooses(store, only)
    records: list[Record] = []
    controls = 1
    for split in splits:
        for _, clip in readable(store.source(split)):
            controls = controls_of(clip, store.manifest)
            if is_demo(clip, only, labelled):
                records.append({"rgb": clip["rgb"], "actions": clip["actions"]})
    if not records:
        which = "can be read"
        if only == "success":
            which = "begins as its episode does" + " and ends in success" * labelled
        raise UserError(
            f"{store.path}: none of its clips ({', '.join(splits)}) {which}; there is nothing to learn from"
        )
    order = np.random.default_rng(seed).permutation(len(records))
    return Demos(tuple(records[number] for number in order), controls)


def is_demo(clip: Record, only: Only, labelled: bool) -> bool:
    """Returns whether a clip is a demonstration.

    Args:
        only: "success" takes the clips that begin as their episodes do and end in success: in a clip that begins in the
            middle, the task may be done before. "all" takes every clip.
        labelled: whether the store says which clips end in success; if not, their ends are not looked at.
    """
    if only == "all":
        return True
    return begins_episode(clip) and (not labelled or bool(clip["success"][-1]))


def chooses(store: Store, only: Only) -> bool:
    """Returns whether to take only clips that end in success; prints a note if the store does not say which do."""
    known = store.manifest.get("success_share") is not None
    if only == "success" and not known:
        note(
            f"{store.path}: does not say which of its clips end in success, so all that begin as their episodes do are "
            f"taken"
        )
    return only == "success" and known


def controls_of(clip: Record, manifest: dict[str, Any]) -> int:
    """Returns the number of controls in a clip's action: the simulator's control steps, or 1 for other recordings."""
    steps = clip["provenance"].get("control_steps") or (manifest.get("config") or {}).get("control_steps")
    if isinstance(steps, int) and steps > 0 and clip["actions"].shape[1] % steps == 0:
        return int(steps)
    return 1
