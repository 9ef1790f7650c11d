"""FVD: the distance of the set of generated videos from the recorded set (Unterthiner et al. 2019, as in StyleGAN-V).

FVD is the Fréchet distance between the features of an I3D network. The network is the file ``i3d_torchscript.pt`` in
``eval.weights``. It resizes frames to 224² itself and runs in PyTorch; without the file or PyTorch, the metric is
unavailable. FVD is one number for all clips, without an interval. It depends on the number and length of the clips:
compare only values where both are equal.
"""

from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from rsjax.config import EvalConfig
from rsjax.errors import UserError, first_line
from rsjax.evaluation.registry import Scene, Scores, Unavailable, metric
from rsjax.files import content_hash
from rsjax.progress import Progress

FILE = "i3d_torchscript.pt"  # in the directory eval.weights
_CLIPS = 4  # clips at a time, to limit memory


class FvdError(UserError):
    """The file of the I3D network is damaged."""


@metric("fvd", "FVD", better="lower", decimals=1, column=False)
def score(scene: Scene) -> Scores:
    """Scores the predicted frames of all clips together."""
    return frechet_distance(scene.of_truth(_truth_features), _features(scene, scene.prediction.rgb))


def frechet_distance(one: Float[np.ndarray, "N D"], other: Float[np.ndarray, "M D"]) -> float:
    """Returns |μ₁ - μ₂|² + tr(Σ₁ + Σ₂ - 2(Σ₁Σ₂)^½) of two sets of features; Σ divides by N or M, not by one less.

    With centred features A and B, tr (Σ₁Σ₂)^½ is the sum of the singular values of A·Bᵀ / √(N·M). This also works with
    fewer videos than features, where Σ₁Σ₂ has no stable square root.
    """
    one, other = (np.asarray(features, np.float64) for features in (one, other))
    shift = np.square(one.mean(0) - other.mean(0)).sum()
    a, b = ((features - features.mean(0)) / np.sqrt(len(features)) for features in (one, other))
    r_a, r_b = (np.asarray(np.linalg.qr(x, mode="r")) for x in (a, b))
    shared = np.linalg.svd(r_a @ r_b.T, compute_uv=False).sum()
    return float(shift + np.square(a).sum() + np.square(b).sum() - 2 * shared)


def check_i3d(settings: EvalConfig) -> None:
    """Checks the file of the network, if it is there and PyTorch is installed.

    Raises:
        FvdError: the file is damaged.
    """
    path = settings.weights_file(FILE)
    if path and find_spec("torch"):
        _load(path, content_hash(Path(path)))


@lru_cache(maxsize=1)
def _load(path: str, content: str) -> Any:
    """Loads the network; ``content``, the file's hash, makes the cache read another file under the same path."""
    import torch

    try:
        return torch.jit.load(path, map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        reason = f"{path}: not a TorchScript network ({first_line(error)}); get i3d_torchscript.pt anew"
        raise FvdError(reason) from error


def _truth_features(scene: Scene) -> Float[np.ndarray, "B D"]:
    return _features(scene, scene.truth.rgb)


def _features(scene: Scene, videos: UInt8[np.ndarray, "B T H W 3"]) -> Float[np.ndarray, "B D"]:
    """Returns the features of the predicted frames of each clip: I3D's last layer before the softmax."""
    path = scene.settings.weights_file(FILE)
    if not path:
        raise Unavailable(f"no {FILE} in eval.weights: put it there, then --eval.weights DIR (docs/evaluation.md)")
    if find_spec("torch") is None:
        raise Unavailable("FVD needs PyTorch: pip install 'rsjax[torch]'")
    import torch

    device = "cuda" if torch.cuda.is_available() else "cpu"
    network = _load(path, content_hash(Path(path))).to(device)
    parts = []
    frames = np.moveaxis(videos[:, scene.prompt_frames :], -1, 1)
    with Progress("FVD", len(frames), "videos") as progress, torch.no_grad():
        for start in range(0, len(frames), _CLIPS):
            clips = torch.from_numpy(np.ascontiguousarray(frames[start : start + _CLIPS])).float().to(device)
            try:
                features = network(clips, rescale=True, resize=True, return_features=True)
            except (RuntimeError, torch.jit.Error) as error:  # its last line has the cause
                cause = str(error).strip().splitlines()[-1]
                raise Unavailable(f"I3D refuses {frames.shape[2]} frames of a clip ({cause})") from error
            parts.append(features.cpu().numpy())
            progress.update(start + len(clips))
    return np.concatenate(parts)
