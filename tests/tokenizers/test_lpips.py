from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from rsjax.config import WEIGHTS
from rsjax.evaluation.metrics.lpips import FILES, how_to_get
from rsjax.tokenizers.lpips import NETS, LpipsError, load_lpips, lpips, lpips_shapes, min_size

TAPS = {"alexnet": (0, 3, 6, 8, 10), "vgg16": (2, 7, 14, 21, 28)}
POOLED = {"alexnet": {3: 3, 6: 3}, "vgg16": {5: 2, 10: 2, 17: 2, 24: 2}}  # max pooling before these, of this side
distance = jax.jit(lpips)


def narrow(net: str) -> dict[str, Any]:
    """Random weights of a net of an eighth of the width."""
    rng = np.random.default_rng(0)
    params: dict[str, Any] = {"backbone": {}, "head": {}}
    for name, shape in lpips_shapes(net).items():
        part, index, kind = name.split(".")
        small = [size if size in (1, 3, 5, 11) else size // 8 for size in shape]
        fan_in = np.prod(small[1:]) if kind == "weight" else 1
        values = rng.normal(scale=np.sqrt(2 / fan_in) if part == "backbone" else 1, size=small)
        values = np.abs(values) if part == "head" else 0.1 * values if kind == "bias" else values
        params[part].setdefault(index, {})[kind] = values.astype(np.float32)
    return params


def windows(x: np.ndarray, size: int, stride: int) -> np.ndarray:
    """(B, C, h, w, size, size) of (B, C, H, W)."""
    return np.lib.stride_tricks.sliding_window_view(x, (size, size), (2, 3))[:, :, ::stride, ::stride]


def by_hand(net: str, params: dict[str, Any], one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The definition, channels first and layer by layer."""
    taps = []
    for images in (one, other):
        x = images.transpose(0, 3, 1, 2)
        x = (x - np.reshape([-0.030, -0.088, -0.188], (3, 1, 1))) / np.reshape([0.458, 0.448, 0.450], (3, 1, 1))
        outputs = []
        for index in sorted(map(int, params["backbone"])):
            if index in POOLED[net]:
                x = windows(x, POOLED[net][index], 2).max((4, 5))
            layer = params["backbone"][str(index)]
            first = net == "alexnet" and index == 0
            pad = 2 if first else layer["weight"].shape[-1] // 2
            x = np.pad(x, ((0, 0), (0, 0), (pad, pad), (pad, pad)))
            x = np.einsum(
                "bchwij,ocij->bohw", windows(x, layer["weight"].shape[-1], 4 if first else 1), layer["weight"]
            )
            x = np.maximum(x + layer["bias"][:, None, None], 0)
            if index in TAPS[net]:
                outputs.append(x / (np.sqrt((x**2).sum(1, keepdims=True)) + 1e-10))
        taps.append(outputs)
    heads = [params["head"][str(k)]["weight"] for k in range(5)]
    return sum(((a - b) ** 2 * w).sum(1).mean((1, 2)) for a, b, w in zip(*taps, heads, strict=True))


def pair(size: int = 39) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    one, other = (rng.uniform(-1, 1, (2, size, size + 4, 3)).astype(np.float32) for _ in range(2))
    return one, other


@pytest.mark.parametrize("net", NETS)
def test_distances_are_the_definition_s(net: str) -> None:
    params = narrow(net)
    found = distance(params, *pair())
    assert found.shape == (2,)
    np.testing.assert_allclose(found, by_hand(net, params, *pair()), rtol=1e-3)
    np.testing.assert_allclose(distance(params, *pair()[::-1]), found, rtol=1e-5)


@pytest.mark.parametrize("net", NETS)
def test_published_weights_give_the_definition_s_distances(net: str) -> None:
    path = Path(WEIGHTS) / FILES[net]
    if not path.exists():
        pytest.skip(f"no {path}: {how_to_get(net)}")
    params = load_lpips(path, net)
    assert all(np.all(head["weight"] >= 0) for head in params["head"].values())  # as they are trained
    one, other = pair()
    exact = by_hand(net, jax.tree.map(np.float64, params), one.astype(np.float64), other.astype(np.float64))
    np.testing.assert_allclose(distance(params, one, other), exact, rtol=0, atol=1e-6)


def test_images_are_no_distance_from_themselves_and_batches_keep_their_shape() -> None:
    one, other = pair()
    stacked = distance(narrow("alexnet"), np.stack([one, one, other]), np.stack([one, other, other]))
    assert stacked.shape == (3, 2)
    np.testing.assert_array_equal(np.asarray(stacked) == 0, [[True] * 2, [False] * 2, [True] * 2])


def test_gradients_are_finite_also_where_no_feature_answers() -> None:
    params = narrow("alexnet")
    dead = params | {"backbone": params["backbone"] | {"0": jax.tree.map(jnp.zeros_like, params["backbone"]["0"])}}
    gradient = jax.jit(jax.grad(lambda p, one, other: jnp.sum(lpips(p, one, other)), argnums=2))
    assert np.all(np.isfinite(gradient(dead, *pair())))
    alive = gradient(params, *pair())
    assert np.all(np.isfinite(alive))
    assert np.any(alive != 0)


@pytest.mark.parametrize("net", NETS)
def test_the_least_size_is_the_first_with_a_distance(net: str) -> None:
    params = narrow(net)
    least = min_size(params)
    for size, defined in ((least, True), (least - 1, False)):
        one, other = pair()[0][:, :size, :size], pair()[1][:, :size, :size]
        assert np.all(np.isfinite(distance(params, one, other))) == defined


def random_file(path: Path, **changes: Any) -> Path:
    rng = np.random.default_rng(0)
    tensors = {n: rng.normal(size=s).astype(np.float32) for n, s in lpips_shapes("alexnet").items()} | changes
    save_file({n: t for n, t in tensors.items() if t is not None}, path, metadata={"net": "alexnet"})
    return path


def test_a_file_of_weights_comes_back_by_the_parts_of_its_names(tmp_path: Path) -> None:
    path = random_file(tmp_path / "alexnet.safetensors")
    params = load_lpips(path)
    for name, tensor in load_file(path).items():
        part, index, kind = name.split(".")
        np.testing.assert_array_equal(params[part][index][kind], tensor)
    assert jax.tree.map(np.ndim, params) == jax.tree.map(np.ndim, narrow("alexnet"))


def test_the_published_networks_have_their_sizes() -> None:
    sizes = {net: sum(int(np.prod(s)) for n, s in lpips_shapes(net).items() if n[0] == "b") for net in NETS}
    assert sizes == {"alexnet": 2_469_696, "vgg16": 14_714_688}
    heads = {net: [s[1] for n, s in lpips_shapes(net).items() if n[0] == "h"] for net in NETS}
    assert heads == {"alexnet": [64, 192, 384, 256, 256], "vgg16": [64, 128, 256, 512, 512]}


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"head.2.weight": None}, "head.2.weight is missing, alexnet needs (1, 384, 1, 1)"),
        ({"head.5.weight": np.zeros(1, np.float32)}, "head.5.weight is (1,), alexnet needs none"),
        ({"backbone.0.bias": np.zeros(63, np.float32)}, "backbone.0.bias is (63,), alexnet needs (64,)"),
    ],
)
def test_weights_that_do_not_fit_are_refused_by_name(tmp_path: Path, changes: dict[str, Any], names: str) -> None:
    path = random_file(tmp_path / "weights.safetensors", **changes)
    with pytest.raises(LpipsError) as caught:
        load_lpips(path)
    assert f"{path}: {names}" in str(caught.value)


def test_there_are_no_weights_but_those_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    with pytest.raises(LpipsError, match="no such LPIPS weights; make them with"):
        load_lpips(path)
    path.write_bytes(b"not safetensors at all")
    with pytest.raises(LpipsError, match="not a safetensors file, or damaged"):
        load_lpips(path)
    save_file({"x": np.zeros(1, np.float32)}, path)
    with pytest.raises(LpipsError, match="name the net None, not one of alexnet, vgg16"):
        load_lpips(path)
