"""FVD: the distance against other computations of it, and the network's part on a small network in its place."""

import sys
from contextlib import nullcontext
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import linalg

from rsjax.clip import Video
from rsjax.config import EvalConfig
from rsjax.evaluation.evaluate import check_files
from rsjax.evaluation.metrics.fvd import FILE, FvdError, frechet_distance
from rsjax.evaluation.registry import Scene, Unavailable
from tests.evaluation.metrics.scored import score


def features(count: int, size: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, size)) @ rng.normal(size=(size, size)) + rng.normal(size=size)


def test_the_distance_is_that_of_the_matrix_square_root() -> None:
    """With more videos than features; scipy computes the root that published code takes."""
    one, other = features(200, 12, 0), features(150, 12, 1)
    (mean, cov), (mean2, cov2) = ((x.mean(0), np.cov(x, rowvar=False, bias=True)) for x in (one, other))
    root = linalg.sqrtm(cov @ cov2)
    expected = np.square(mean - mean2).sum() + np.trace(cov + cov2 - 2 * np.real(root))
    assert frechet_distance(one, other) == pytest.approx(expected, rel=1e-9)


def test_fewer_videos_than_features() -> None:
    """The eigenvalues of Σ₁Σ₂ are real and not negative: the trace of its root is the sum of their roots."""
    one, other = features(9, 30, 2), features(7, 30, 3)
    cov, cov2 = (np.cov(x, rowvar=False, bias=True) for x in (one, other))
    roots = np.sqrt(np.maximum(np.linalg.eigvals(cov @ cov2).real, 0)).sum()
    expected = np.square(one.mean(0) - other.mean(0)).sum() + np.trace(cov) + np.trace(cov2) - 2 * roots
    assert frechet_distance(one, other) == pytest.approx(expected, rel=1e-4)


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that is called as I3D is, of which features are means over channels, first frame and last frame."""
    torch = pytest.importorskip("torch")
    path = tmp_path_factory.mktemp("fvd") / FILE
    code = """
def forward(self, x: Tensor, rescale: bool, resize: bool, return_features: bool) -> Tensor:
    assert rescale and resize and return_features and x.dim() == 5 and x.size(1) == 3
    if x.size(2) < 3:
        raise RuntimeError("too short")
    x = x / 255
    return torch.cat([x.mean((2, 3, 4)), x[:, :, 0].mean((2, 3)), x[:, :, -1].mean((2, 3))], 1)
"""
    scripted = torch.jit.ScriptModule()
    scripted.define(code)
    scripted.save(str(path))
    return path


def scene(settings: EvalConfig, frames: int = 6) -> Scene:
    truth, made = np.random.default_rng(0).integers(0, 256, (2, 9, frames, 8, 10, 3), np.uint8)
    return Scene(Video(truth), Video(made), prompt_frames=2, settings=settings)


def test_the_network_sees_the_predicted_frames_as_channels_first_videos(network: Path) -> None:
    given = scene(EvalConfig(weights=str(network.parent)))

    def seen(video: Video) -> np.ndarray:
        later = video.rgb[:, 2:] / 255
        return np.concatenate([later.mean((1, 2, 3)), later[:, 0].mean((1, 2)), later[:, -1].mean((1, 2))], axis=1)

    expected = frechet_distance(seen(given.truth), seen(given.prediction))
    assert score("fvd", given) == pytest.approx(expected, rel=1e-3)
    assert score("fvd", Scene(given.truth, given.truth, settings=given.settings)) == pytest.approx(0, abs=1e-6)
    with pytest.raises(Unavailable, match="I3D refuses 2 frames of a clip"):
        score("fvd", scene(given.settings, frames=4))


class Numbers:
    """An array with the methods of a tensor that the metric calls."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __len__(self) -> int:
        return len(self.values)

    def float(self) -> "Numbers":
        return Numbers(self.values.astype(np.float32))

    def numpy(self) -> np.ndarray:
        return self.values

    def to(self, device: str) -> "Numbers":
        return self

    cpu = eval = lambda self: self


class Scaled(Numbers):
    """A network whose features are the frames' means, times the number in its file."""

    def __call__(self, clips: Numbers, **options: bool) -> Numbers:
        return Numbers(self.values * clips.values.mean((2, 3, 4)))


def test_another_network_at_the_same_path_is_read_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stand-in for PyTorch, which need not be installed."""
    torch: Any = ModuleType("torch")
    torch.__spec__ = ModuleSpec("torch", None)
    torch.cuda = SimpleNamespace(is_available=lambda: False)
    torch.jit = SimpleNamespace(load=lambda path, map_location: Scaled(np.array(float(Path(path).read_text()))))
    torch.no_grad = nullcontext
    torch.from_numpy = Numbers
    monkeypatch.setitem(sys.modules, "torch", torch)
    values = []
    for scale in ("1", "2"):
        (tmp_path / FILE).write_text(scale)
        values.append(score("fvd", scene(EvalConfig(weights=str(tmp_path)))))
    assert values[1] == pytest.approx(4 * values[0], rel=1e-3)


def test_without_network_or_torch_there_is_a_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / FILE).write_bytes(b"")
    with pytest.raises(Unavailable, match=r"no i3d_torchscript.pt in eval.weights"):
        score("fvd", scene(EvalConfig(weights="")))
    monkeypatch.setattr("rsjax.evaluation.metrics.fvd.find_spec", lambda name: None)
    with pytest.raises(Unavailable, match="FVD needs PyTorch: pip install"):
        score("fvd", scene(EvalConfig(weights=str(tmp_path))))


def test_a_damaged_file_is_refused_at_the_start(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    (tmp_path / FILE).write_bytes(b"no network")
    with pytest.raises(FvdError, match=r"i3d_torchscript.pt: not a TorchScript network"):
        check_files(EvalConfig(weights=str(tmp_path)))
