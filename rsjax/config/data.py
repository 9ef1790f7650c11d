"""What the clips are like that everything else has to fit, and a store of clips that was not simulated."""

from dataclasses import dataclass

from rsjax.config.fields import require, runtime


@dataclass(frozen=True)
class ClipShape:
    """A data set's clips: frames, pixels of a side, tracks N₀, width of a frame's action, clips of the test split."""

    frames: int
    image_size: int
    tracks: int
    action_dim: int
    test_clips: int


@dataclass(frozen=True)
class DataConfig:
    """A store of clips, as ``experiments.ingest`` makes it, to train on in place of simulated episodes.

    ``experiments.train --store`` fills it in (:func:`rsjax.pipeline.own_data.on_store`).
    """

    store: str = runtime("")  # where it lies
    key: str = ""  # its content key, by which a run knows it wherever it lies; empty: episodes are simulated
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
        """What its clips are like."""
        return ClipShape(self.frames, self.image_size, self.tracks, self.action_dim, self.test_clips)
