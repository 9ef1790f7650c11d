"""The interface of models that can continue a clip from any frame, in several ways; ``rsjax play`` needs it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from rsjax.clip import Video


@dataclass(frozen=True)
class Decoding:
    """The settings with which one frame is decoded.

    Attributes:
        steps, temperature, guidance, top_k: as in :class:`rsjax.config.SampleConfig`.
        seed, draw: numbers from 0 to 2³² - 1, which with the frame's number decide the random draws. With the seed of
            the model's settings and a clip's number as ``draw``, the draws are those of :meth:`WorldModel.generate`.
    """

    steps: int
    temperature: float = 0.0
    guidance: float = 1.0
    top_k: int = 0
    seed: int = 0
    draw: int = 0

    @property
    def program(self) -> tuple[int, int, bool]:
        """The settings that frames must have in common to be generated in one pass."""
        return self.steps, self.top_k, self.temperature > 0


@dataclass(frozen=True)
class BranchState:
    """A frame of a clip, and the memory from which the next one is generated.

    Attributes:
        rgb: the frame.
        tokens: its tokens by branch, (S,).
        entropy: of each RGB token when it was decided, in nats, (S,); None for a first frame.
        memory: in a form that only the family knows; None if it was used up.
        size: bytes of the part of the memory that :meth:`Branching.lightened` leaves out.
        means: the mean codes by branch that the frame is decoded from, (S, D); if empty, it is decoded from its tokens.
        features: what the model knows of the frame before it sees any of its cells, from the frames before and the
            action: the mean over its cells (:attr:`rsjax.models.base.TeacherForced.features`); None for a first frame
            or a family that has none.
        state: what the model's state heads read (a column of :attr:`rsjax.clip.Video.state`); None without heads.
    """

    rgb: UInt8[np.ndarray, "H W 3"]
    tokens: dict[str, Int[np.ndarray, " S"]]
    entropy: Float[np.ndarray, " S"] | None
    memory: Any
    size: int = 0
    means: dict[str, Float32[np.ndarray, "S D"]] = field(default_factory=dict)
    features: Float32[np.ndarray, " C"] | None = None
    state: Float32[np.ndarray, " K"] | None = None


class Branching(Protocol):
    """Generates clips frame by frame; each clip may continue from any of its frames in several ways."""

    lanes: int  # clips that one pass generates

    def begin(self, first: Video) -> BranchState:
        """Returns the first frame of a clip, (1, 1, …), as the model sees it."""
        ...

    def advance(
        self, states: Sequence[BranchState], actions: Float[np.ndarray, "N A"], decodings: Sequence[Decoding]
    ) -> list[BranchState]:
        """Generates the next frame of each of these states, at most ``lanes``, and uses up their memories.

        A frame has the same bits whichever other frames are generated in the same pass.

        Args:
            states: with memories.
            actions: in the recording's units.
            decodings: with the same ``program``.
        """
        ...

    def lightened(self, state: BranchState) -> BranchState:
        """Returns the state with a small memory, which :meth:`advance` does not use up, or with none.

        First frames have a small memory, and some later frames do. The frames that follow have the same bits.
        """
        ...

    def depth(self, state: BranchState) -> Float32[np.ndarray, "H W"] | None:
        """Returns a frame's depth in metres; None if its clip has none."""
        ...
