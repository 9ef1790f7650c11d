from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from rsjax.clip import Video
from rsjax.config import ConfigError, EvalConfig
from rsjax.evaluation.evaluate import check_files
from rsjax.evaluation.metrics.lpips import FILES, advice, distances
from rsjax.evaluation.registry import Scene, Unavailable, metrics
from rsjax.tokenizers.lpips import LpipsError, load_lpips, lpips_shapes

METRICS = {"alexnet": "lpips_alex", "vgg16": "lpips_vgg"}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Random weights of both networks, of the published sizes."""
    paths = {net: tmp_path_factory.mktemp("lpips") / name for net, name in FILES.items()}
    for net, path in paths.items():
        rng, tensors = np.random.default_rng(0), {}
        for name, shape in lpips_shapes(net).items():
            scale = np.sqrt(2 / np.prod(shape[1:])) if "backbone" in name and len(shape) > 1 else 0.1
            values = rng.normal(scale=scale, size=shape).astype(np.float32)
            tensors[name] = np.abs(values) if "head" in name else values
        save_file(tensors, path, metadata={"net": net})
    return paths


def scene(settings: EvalConfig, side: int = 32) -> Scene:
    rng = np.random.default_rng(1)
    truth = rng.integers(0, 256, (2, 3, side, side + 6, 3), np.uint8)
    noise = rng.integers(-60, 60, truth.shape)
    return Scene(Video(truth), Video(np.clip(truth + noise, 0, 255).astype(np.uint8)), settings=settings)


def plain_torch(net: str, path: Path, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The public definition in torch's own layers, in the order of torchvision's ``features``; (N, H, W, 3), 0–255."""
    torch = pytest.importorskip("torch")
    nn, weights = torch.nn, {name: torch.from_numpy(x) for name, x in load_file(path).items()}
    if net == "alexnet":
        layers = [nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, padding=2)]
        layers += [nn.ReLU(), nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()]
        layers += [nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(), nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()]
        taps = (1, 4, 7, 9, 11)
    else:
        layers, width = [], 3
        for size in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
            layers += [nn.Conv2d(width, size, 3, padding=1), nn.ReLU()] if size else [nn.MaxPool2d(2, 2)]
            width = size or width
        taps = (3, 8, 15, 22, 29)
    features = nn.Sequential(*layers)
    features.load_state_dict({n.removeprefix("backbone."): x for n, x in weights.items() if n.startswith("backbone")})

    def tapped(images: np.ndarray) -> list:
        x = torch.from_numpy(images).permute(0, 3, 1, 2).double() / 255 * 2 - 1
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        x, outputs = (x - shift[:, None, None]) / scale[:, None, None], []
        for number, layer in enumerate(features.double()):
            x = layer(x)
            if number in taps:
                outputs.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return outputs

    with torch.no_grad():
        pairs = enumerate(zip(tapped(one), tapped(other), strict=True))
        terms = [
            nn.functional.conv2d((a - b) ** 2, weights[f"head.{k}.weight"].double()).mean((1, 2, 3))
            for k, (a, b) in pairs
        ]
    return sum(terms).numpy()


@pytest.mark.parametrize("net", METRICS)
def test_the_metric_is_the_public_definition_over_predicted_frames(net: str, files: dict[str, Path]) -> None:
    given = scene(EvalConfig(weights=str(files[net].parent)))
    function = metrics()[METRICS[net]].function
    assert function is not None
    truth, predicted = (video.rgb[:, 1:].reshape(-1, 32, 38, 3) for video in (given.truth, given.prediction))
    expected = plain_torch(net, files[net], truth, predicted).reshape(2, 2).mean(1)
    np.testing.assert_allclose(np.asarray(function(given)), expected, rtol=1e-4)
    np.testing.assert_array_equal(function(Scene(given.truth, given.truth, settings=given.settings)), 0)


@pytest.mark.parametrize("net", METRICS)
def test_without_weights_or_room_there_is_a_reason_and_no_number(net: str, files: dict[str, Path]) -> None:
    function = metrics()[METRICS[net]].function
    assert function is not None
    with pytest.raises(Unavailable, match=rf"^no {FILES[net]} in eval.weights: rsjax convert lpips --net"):
        function(scene(EvalConfig(weights="")))
    with pytest.raises(Unavailable, match=f"frames of 15 pixels; LPIPS with {net} needs"):
        function(scene(EvalConfig(weights=str(files[net].parent)), side=15))


def test_a_missing_directory_or_a_file_of_the_other_network_is_refused_at_the_start(
    files: dict[str, Path], tmp_path: Path
) -> None:
    for path in files.values():
        check_files(EvalConfig(weights=str(path.parent)))
    (tmp_path / FILES["alexnet"]).write_bytes(files["vgg16"].read_bytes())
    with pytest.raises(LpipsError, match=r"lpips_alex.safetensors: these LPIPS weights are of vgg16, not of"):
        check_files(EvalConfig(weights=str(tmp_path)))
    with pytest.raises(ConfigError, match="eval.weights is nowhere: no such directory"):
        check_files(EvalConfig(weights="nowhere"))
    for settings in (EvalConfig(weights=""), EvalConfig(weights=str(tmp_path))):
        assert advice(settings) == ""
    (tmp_path / FILES["alexnet"]).unlink()
    assert "rsjax convert lpips --net alex gets them" in advice(EvalConfig(weights=str(tmp_path)))


def test_batches_of_any_size_have_the_distances_of_single_pairs(files: dict[str, Path]) -> None:
    params = load_lpips(files["alexnet"])
    truth, prediction = (np.random.default_rng(seed).integers(0, 256, (11, 32, 34, 3), np.uint8) for seed in (0, 1))
    together = distances(params, truth, prediction)
    alone = [distances(params, truth[i : i + 1], prediction[i : i + 1])[0] for i in range(11)]
    np.testing.assert_allclose(together, alone, rtol=1e-5)
