import importlib.util
import sys

import pytest

from rsjax.ingest.annotators.networks.local import _build


def _operators() -> object:
    """Lets a torchvision that was built for CUDA be imported beside a torch without.

    Its compiled part does not load there, and the import then wants these two operators declared. RAFT and image
    processors are plain Python and call neither. Beside its own torch nothing is needed.
    """
    if not (importlib.util.find_spec("torch") and importlib.util.find_spec("torchvision")):
        return None
    import torch

    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        declared = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            declared.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        return declared
    return None


_OPERATORS = _operators()  # undeclared again when it is deleted


@pytest.fixture(autouse=True)
def _unloaded():
    """Unloads what a test has loaded: models, and the packages of checkouts."""
    yield
    _build.cache_clear()
    for name in [*sys.modules]:
        if name.partition(".")[0] in ("models", "tapnet", "video_depth_anything"):
            del sys.modules[name]
