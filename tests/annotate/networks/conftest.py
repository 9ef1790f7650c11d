import sys

import pytest

from rsjax.annotate.networks import depth, motion, semantics, shots, tracks


@pytest.fixture(autouse=True)
def _forgotten():
    """Nothing that a test loads stays for the next one: models, and the packages of checkouts."""
    yield
    loaders = (depth._load_video, depth._load_frames, motion._load, semantics._load, shots._load)
    for loader in (*loaders, tracks._load_spatial, tracks._load_tapir):
        loader.cache_clear()
    for name in [
        name for name in sys.modules if name.partition(".")[0] in ("models", "tapnet", "video_depth_anything")
    ]:
        del sys.modules[name]
