from typing import Any

import jax
import numpy as np

from rsjax.tokenizers.discriminator import MIN_SIZE, BatchNorm, Discriminator

SHAPES: Any = jax.eval_shape(Discriminator().init_params, jax.random.key(0))


def conv4(x: np.ndarray, kernel: np.ndarray, stride: int) -> np.ndarray:
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    rows, columns = (range(0, size - 1, stride) for size in x.shape[1:3])
    return np.stack(
        [
            np.stack([np.einsum("bijc,ijco->bo", padded[:, r : r + 4, c : c + 4], kernel) for c in columns], axis=1)
            for r in rows
        ],
        axis=1,
    )


def leaky(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, 0.2 * x)


def test_it_has_the_published_parameters() -> None:
    assert sum(x.size for x in jax.tree.leaves(SHAPES)) == 2_765_633
    assert set(SHAPES) == {f"main_{i}" for i in (0, 2, 3, 5, 6, 8, 9, 11)}
    assert {name for name, layer in SHAPES.items() if "kernel" in layer and "bias" in layer} == {"main_0", "main_11"}


def test_fresh_weights_are_small_and_norms_near_one() -> None:
    params = jax.jit(Discriminator().init_params)(jax.random.key(0))
    for name in ("main_2", "main_5", "main_8"):
        np.testing.assert_allclose(np.std(params[name]["kernel"]), 0.02, rtol=0.02)
    for name in ("main_3", "main_6", "main_9"):
        np.testing.assert_allclose(np.mean(params[name]["scale"]), 1.0, atol=0.01)
        np.testing.assert_allclose(np.std(params[name]["scale"]), 0.02, rtol=0.3)


def test_logits_are_the_plain_computation() -> None:
    rng = np.random.default_rng(0)
    scales = {"kernel": 0.05, "scale": 1.0, "bias": 0.5}
    params = {
        layer: {name: rng.normal(scale=scales[name], size=x.shape).astype(np.float32) for name, x in parts.items()}
        for layer, parts in SHAPES.items()
    }
    images = rng.uniform(-1, 1, (3, MIN_SIZE + 8, MIN_SIZE, 3)).astype(np.float32)
    x = leaky(conv4(images, params["main_0"]["kernel"], 2) + params["main_0"]["bias"])
    for index, stride in ((2, 2), (5, 2), (8, 1)):
        x = conv4(x, params[f"main_{index}"]["kernel"], stride)
        norm = params[f"main_{index + 1}"]
        x = (x - x.mean((0, 1, 2))) / np.sqrt(x.var((0, 1, 2)) + 1e-5) * norm["scale"] + norm["bias"]
        x = leaky(x)
    x = conv4(x, params["main_11"]["kernel"], 1) + params["main_11"]["bias"]
    logits = jax.jit(Discriminator().apply)({"params": params}, images)
    assert logits.shape == (3, 2, 1)
    np.testing.assert_allclose(logits, x[..., 0], rtol=1e-3, atol=1e-3)


def test_statistics_are_those_of_all_devices_images() -> None:
    x = jax.random.normal(jax.random.key(1), (4, 2, 3, 3, 5)) + jax.numpy.arange(4.0)[:, None, None, None, None]
    params = {"params": {"scale": jax.numpy.full(5, 2.0), "bias": jax.numpy.arange(5.0)}}
    whole = BatchNorm().apply(params, x.reshape(8, 3, 3, 5))
    parts = jax.vmap(lambda part: BatchNorm("devices").apply(params, part), axis_name="devices")(x)
    np.testing.assert_allclose(np.asarray(parts).reshape(8, 3, 3, 5), np.asarray(whole), rtol=1e-4, atol=1e-5)
