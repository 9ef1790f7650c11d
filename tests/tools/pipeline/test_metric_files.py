import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rsjax.config import ConfigError, EvalConfig
from rsjax.evaluation.depth_estimator import estimate_depth
from rsjax.tools.ingest.annotators.depth import metric_depth, relative_depth
from rsjax.tools.ingest.annotators.protocols import AnnotationError, DepthMaps
from rsjax.tools.ingest.episode import Episode
from rsjax.tools.pipeline.metric_files import Estimator, by_content, check_metric_files, load_estimator
from tests.tools.ingest.annotators.networks.checkouts import check_out


@dataclass(frozen=True)
class Brightness:
    """Takes a pixel's mean level, and a bit, for its 1/depth or its decimetres."""

    metric: bool

    def __call__(self, episode: Episode, camera: str) -> DepthMaps:
        frames = episode.cameras[camera]
        level = frames.read(range(len(frames))).mean(-1).astype(np.float32) + 20
        return metric_depth(level / 10) if self.metric else relative_depth(level)


def videos(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(60, 200, (3, 4, 5, 6, 3), np.uint8)


def test_an_annotators_maps_are_adapted_with_their_unit() -> None:
    frames = videos(0)[0]
    level = frames.mean(-1) + 20
    metres = Estimator(Brightness(metric=True))(frames)
    assert metres.unit == "metres"
    np.testing.assert_allclose(metres.maps, level / 10, rtol=1e-6)
    inverse = Estimator(Brightness(metric=False))(frames)
    assert inverse.unit == "relative 1/depth"
    np.testing.assert_allclose(inverse.maps, level, rtol=1e-5)
    np.testing.assert_allclose(inverse.extent, (level.min(), level.max()), rtol=1e-6)


def test_the_configured_network_is_loaded_from_its_files(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    checkout = check_out(tmp_path, "video_depth_anything/video_depth.py")
    torch.save({"scale": torch.full((64,), 2.0)}, tmp_path / "w")
    word = f"video-depth-anything:checkout={checkout},weights={tmp_path / 'w'},device=cpu"
    estimator = load_estimator(EvalConfig(depth_estimator=word))
    assert estimator is not None
    truth, made = videos(0), videos(1)
    reference = Estimator(Brightness(metric=False))
    both = [estimate_depth(network, truth, {"": made})[""] for network in (estimator, reference)]
    np.testing.assert_allclose(both[0].prediction, both[1].prediction, rtol=1e-3)
    (tmp_path / "w").write_bytes(b"not weights")
    with pytest.raises(AnnotationError, match="not the weights of Video Depth Anything"):
        load_estimator(EvalConfig(depth_estimator=f"{word},input_size=14"))
    for name in [name for name in sys.modules if name.startswith("video_depth_anything")]:
        del sys.modules[name]  # other tests have checkouts of their own


def test_an_estimator_is_known_by_the_content_of_its_files(tmp_path: Path) -> None:
    def described(folder: Path, more: str = "") -> str:
        word = f"video-depth-anything:checkout={folder},weights={folder / 'w'}{more}"
        return by_content(EvalConfig(depth_estimator=word)).depth_estimator

    for name in ("here", "there"):
        check_out(tmp_path / name, "video_depth_anything/video_depth.py")
        (tmp_path / name / "w").write_bytes(b"1")
    here, there = tmp_path / "here", tmp_path / "there"
    first = described(here)
    (there / "README.md").write_text("no code")
    assert described(there) == first != described(there, ",input_size=14")
    assert str(tmp_path) not in first
    (there / "w").write_bytes(b"2")
    (here / "video_depth_anything" / "more.py").touch()
    assert len({first, described(there), described(here)}) == 3
    assert by_content(EvalConfig(weights="")) == EvalConfig(weights="")


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("midas", "eval.depth_estimator: depth: no method 'midas'; choose"),
        ("recorded", "eval.depth_estimator: 'recorded' is not a network"),
        ("none", "eval.depth_estimator: 'none' is not a network"),
        ("depth-anything", "eval.depth_estimator: depth depth-anything: model missing; write"),
        ("depth-anything:model=nowhere", r"eval.depth_estimator: model .*/nowhere does not exist"),
    ],
)
def test_an_estimator_that_cannot_be_is_refused_at_the_start(word: str, message: str) -> None:
    assert load_estimator(EvalConfig()) is None
    with pytest.raises(ConfigError, match=message):
        check_metric_files(EvalConfig(depth_estimator=word))
