import numpy as np
import pytest

from rsjax.tools.studies.report.figures import ClipFigure


@pytest.fixture(scope="session")
def make_clip():
    """Makes a clip of a bright square that moves right over a dark background, with every optional field."""

    def make(frames=6, size=32, **changes):
        rgb = np.full((frames, size, size, 3), 40, np.uint8)
        depth = np.full((frames, size, size), 2.0, np.float32)
        for t in range(frames):
            rgb[t, 8:16, 4 + t : 12 + t] = (220, 60, 40)
            depth[t, 8:16, 4 + t : 12 + t] = 1.0
        tracks = np.full((8, frames, 2), 0.25, np.float32)
        tracks[0, :, 0] += np.arange(frames) / size
        fields = {
            "title": "episode <7>",
            "truth": rgb,
            "prediction": rgb // 2,
            "reconstruction": rgb // 3,
            "other_actions": rgb[::-1],
            "true_depth": depth,
            "predicted_depth": depth * 1.1,
            "tracks": tracks,
            "visible": np.ones((8, frames), bool),
            "selected": np.array([0]),
        }
        return ClipFigure(**(fields | changes))

    return make
