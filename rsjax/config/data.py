"""The shape of a data set's clips, and settings of a store of ingested clips."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class ClipShape:
    """Shape of a data set's clips: frames, pixels per side, tracks N₀, numbers in a frame's action; test clips."""

    frames: int  # of a clip
    image_size: int  # pixels a side
    tracks: int  # N₀, of each clip
    action_dim: int  # numbers in a frame's action
    test_clips: int  # clips of the test split


@dataclass(frozen=True)
class DataConfig:
    """A store of clips made by ``rsjax ingest``, to train on instead of simulated episodes.

    ``--store`` fills it in (:func:`rsjax.tools.pipeline.run_clips.on_store`). A preset may give the shape of the clips
    alone, without path and key: enough to describe and compile it, not to train.
    """

    store: str = field(metadata={"runtime": True})  # its path
    key: str  # its content key, which identifies it wherever it is
    frames: int  # of a clip; the store's, as are the four that follow
    image_size: int  # pixels a side
    tracks: int  # N₀, of each clip
    action_dim: int  # numbers in a frame's action
    test_clips: int  # clips of the test split

    @property
    def clips(self) -> ClipShape:
        """The shape of its clips."""
        return ClipShape(self.frames, self.image_size, self.tracks, self.action_dim, self.test_clips)
