"""The shape of a data set's clips, and settings of a store of ingested clips."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class ClipShape:
    """Shape of a data set's clips: frames, pixels per side, tracks N₀, numbers in a frame's action; test clips."""

    frames: int
    image_size: int
    tracks: int
    action_dim: int
    test_clips: int


@dataclass(frozen=True)
class DataConfig:
    """A store of clips made by ``rsjax ingest``, to train on instead of simulated episodes.

    ``--store`` fills it in (:func:`rsjax.tools.pipeline.run_clips.on_store`).
    """

    store: str = field(metadata={"runtime": True})  # its path
    key: str  # its content key, which identifies it wherever it is
    frames: int
    image_size: int
    tracks: int
    action_dim: int
    test_clips: int

    @property
    def clips(self) -> ClipShape:
        """The shape of its clips."""
        return ClipShape(self.frames, self.image_size, self.tracks, self.action_dim, self.test_clips)
