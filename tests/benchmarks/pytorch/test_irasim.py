"""IRASim in PyTorch has the same network, and everything is timed."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from rsjax.config import Config
from rsjax.config.config_fields import with_values
from rsjax.models.base import create_model
from rsjax.models.irasim.dit import DiT, architecture
from rsjax.tools.bench.run import bench
from rsjax.tools.convert.irasim import Variant, from_public
from rsjax.tools.describe import count
from tests.benchmarks.pytorch.eager import EAGER
from tests.models.irasim import public, toy

torch = pytest.importorskip("torch")
pytest.importorskip("diffusers")

DEPTH = with_values(toy.config(), {"model.autoencoder.depth": "inverse"})


@pytest.mark.parametrize("video", [False, True], ids=["frame", "video"])
def test_output_is_that_of_the_network(video: bool) -> None:
    from benchmarks.pytorch.irasim import IRASimTorch

    net = public.Network(video=video)
    tensors = public.random_weights(net)
    config, params, _ = from_public("file", tensors, variant=Variant(net.heads, "video" if video else None))
    reference = IRASimTorch(replace(config, rows=net.grid[0] * net.patch, columns=net.grid[1] * net.patch))
    reference.load_state_dict({name: torch.tensor(x) for name, x in tensors.items()})
    rng = np.random.default_rng(0)
    latents = rng.normal(size=(2, net.frames, 8, 10, net.channels)).astype(np.float32)
    actions, t = rng.normal(size=(2, net.frames, net.actions)).astype(np.float32), np.array([3, 700])
    with torch.no_grad():
        made = reference(torch.tensor(latents).permute(0, 1, 4, 2, 3), torch.tensor(t), torch.tensor(actions[:, 1:]))
    own = jax.jit(DiT(config).apply)({"params": params}, latents, t, actions)
    np.testing.assert_allclose(own, made.permute(0, 1, 3, 4, 2), atol=2e-5)


def test_with_depth_the_network_has_as_many_more_parameters_as_ours() -> None:
    from benchmarks.pytorch.irasim import IRASimTorch

    sizes = []
    for config in (toy.config(), DEPTH):
        ours = jax.eval_shape(create_model(config).init, jax.random.key(0))
        sizes.append((sum(x.numel() for x in IRASimTorch(architecture(config)).parameters()), count(ours)))
    (theirs, ours), (theirs_deep, ours_deep) = sizes
    assert theirs_deep - theirs == ours_deep - ours > 0


@pytest.mark.parametrize("config", [toy.config(), DEPTH], ids=["rgb", "depth"])
def test_all_parts_are_timed_in_both_types(config: Config) -> None:
    numbers = bench(config, only=["tokenizer", "sample"], horizons=(8,), budget=0.0, rival=EAGER)
    for dtype in ("float32", "bfloat16"):
        assert numbers[f"torch_train_step_s_{dtype}"] > 0
        for name in ("sample", "tokenizer_encode", "tokenizer_decode"):
            assert numbers[f"{name}_speedup_over_torch_{dtype}"] > 0
