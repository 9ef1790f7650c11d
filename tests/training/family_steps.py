"""Takes one step of each family's networks under two shardings, on four virtual devices.

Prints, as JSON by network, how far the gradient of the mesh (2 × 2, every array cut) and that of pmap with two
accumulated parts are apart, as a share. The clips' weights are uneven, so that ratios of single devices would differ.
iVideoGPT's and CogVideoX's autoencoders, which take a minute each to compile, are left to

    XLA_FLAGS=--xla_force_host_platform_device_count=4 python -m tests.training.family_steps all
"""

import json
import sys
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from rsjax.config import AdamW, LoopConfig
from rsjax.training import sharding as sharding_rules
from rsjax.training.state import create_state
from tests.models import families
from tests.training.devices import Training, moments, share

LOOP = LoopConfig(batch_size=8, steps=1, optimizer=AdamW(warmup_steps=1))
WEIGHTS = np.array([1, 1, 1, 0, 0, 0, 1, 1], np.float32)


def apart(model: Any, shapes: Any, batch: Any) -> float:
    """How far the gradients of the two shardings are apart."""
    rng = np.random.default_rng(1)
    batch = jax.device_get(batch) | ({"weight": WEIGHTS} if "weight" in batch else {})
    params = jax.tree.map(lambda x: (0.1 * rng.normal(size=x.shape)).astype(np.float32), shapes)
    start = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), jax.eval_shape(lambda: create_state(model, LOOP)))
    kinds = {"fsdp": LOOP, "pmap": replace(LOOP, accumulate=2)}
    trainings = (Training(kind, model, loop, [batch], start.replace(params=params)) for kind, loop in kinds.items())
    return share(*(moments(training.run(0, 1)) for training in trainings))


def main(slow: bool) -> dict[str, float]:
    sharding_rules.SMALL = 0
    found = {}
    for name in ("ivideogpt", "irasim", "cogvideox"):
        networks = list(families.batches_of(families.FAMILIES[name](), 8))
        for model, shapes, batch in networks if slow or name == "irasim" else networks[-1:]:
            found[type(model).__name__] = apart(model, shapes, batch)
    return found


if __name__ == "__main__":
    assert jax.local_device_count() == 4
    print(json.dumps(main(slow="all" in sys.argv)))
