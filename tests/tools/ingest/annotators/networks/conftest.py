import sys

import pytest

from rsjax.tools.ingest.annotators.network import _build


@pytest.fixture(autouse=True)
def _unloaded():
    """Unloads what a test has loaded: models, and the packages of checkouts."""
    yield
    _build.cache_clear()
    for name in [*sys.modules]:
        if name.partition(".")[0] in ("models", "tapnet", "video_depth_anything"):
            del sys.modules[name]
