"""Lays out a clip as one sequence of numbers: the tokens of context frames, then a slot and few tokens per later frame.

Context tokens are 0 … K-1 and tokens of later frames K … 2K-1. 2K separates context frames. 2K+1 is the slot before a
later frame; the model adds the action that led to that frame at the slot's position.

Axes: B clips, c context frames, F later frames, S tokens of a context frame, n tokens of a later frame, L length.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from rsjax.models.ivideogpt.config import IVideoGPTConfig


@dataclass(frozen=True)
class Layout:
    """The lengths and numbers of these sequences.

    Attributes:
        codes: K, the number of codes in each codebook.
        context: c, the number of context frames, which have all their tokens.
        cells: S, the tokens of a context frame.
        tokens: n, the tokens of a later frame.
        positions: the length of the longest sequence.
    """

    codes: int
    context: int
    cells: int
    tokens: int
    positions: int

    @classmethod
    def create(cls, config: IVideoGPTConfig, image_size: int) -> "Layout":
        """Returns the layout for clips of this size."""
        vq = config.autoencoder
        cells = vq.grid(image_size) ** 2
        tokens = vq.future_tokens(image_size)
        return cls(vq.codes, vq.context_frames, cells, tokens, config.positions)

    @property
    def vocabulary(self) -> int:
        """The size of the vocabulary: 2K + 2."""
        return 2 * self.codes + 2

    @property
    def separator(self) -> int:
        """The number between context frames."""
        return 2 * self.codes

    @property
    def slot(self) -> int:
        """The number before each later frame."""
        return 2 * self.codes + 1

    @property
    def per_frame(self) -> int:
        """Positions of a later frame: its slot and its tokens."""
        return self.tokens + 1

    @property
    def first_slot(self) -> int:
        """The position of the first slot, after the context."""
        return self.context * (self.cells + 1) - 1

    @property
    def most_frames(self) -> int:
        """Frames of the longest sequence, context included."""
        return self.context + (self.positions - self.first_slot) // self.per_frame

    def length(self, frames: int) -> int:
        """Returns the length of a sequence of ``frames`` frames, context included."""
        return self.first_slot + self.per_frame * (frames - self.context)

    def join(self, context: Int[np.ndarray, "B c ..."], future: Int[np.ndarray, "B F n"]) -> Int[np.ndarray, "B L"]:
        """Returns clips' sequences from their tokens."""
        clips, later = future.shape[:2]
        separated = np.full((clips, self.context, self.cells + 1), self.separator, np.int32)
        separated[:, :, 1:] = context.reshape(clips, self.context, self.cells)
        slotted = np.full((clips, later, self.per_frame), self.slot, np.int32)
        slotted[:, :, 1:] = future + self.codes
        return np.concatenate([separated.reshape(clips, -1)[:, 1:], slotted.reshape(clips, -1)], axis=1)

    def future(self, tail: Int[np.ndarray, "B N"]) -> Int[np.ndarray, "B F n"]:
        """Returns the tokens 0 … K-1 of later frames from a sequence's part after the context.

        Sampling may draw numbers that are not tokens of later frames; each becomes the nearest such token.
        """
        slotted = tail.reshape(len(tail), -1, self.per_frame)
        return np.clip(slotted[:, :, 1:] - self.codes, 0, self.codes - 1)
