"""The shape of a data set's clips, and settings of a store of ingested clips."""

from dataclasses import dataclass

from rsjax.config.fields import require, runtime


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
    """A store of clips made by ``experiments.ingest``, to train on instead of simulated episodes.

    ``--store`` fills it in (:func:`rsjax.tools.pipeline.run_clips.on_store`).
    """

    store: str = runtime("")  # its path
    key: str = ""  # its content key, which identifies it wherever it is; empty: episodes are simulated
    frames: int = 0
    image_size: int = 0
    tracks: int = 0
    action_dim: int = 0
    test_clips: int = 0

    def __post_init__(self) -> None:
        require(
            bool(self.store) == bool(self.key),
            f"data.store is {self.store!r} and data.key is {self.key!r}; name a store with --store, which sets both",
        )

    @property
    def clips(self) -> ClipShape:
        """The shape of its clips."""
        return ClipShape(self.frames, self.image_size, self.tracks, self.action_dim, self.test_clips)
