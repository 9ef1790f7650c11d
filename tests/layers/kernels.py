"""Where kernels run in tests: on a GPU if there is one, and otherwise in Pallas' interpreter, slowly."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import AbstractDevice, AbstractMesh, use_abstract_mesh

from rsjax.layers.platform import for_all_platforms

INTERPRETED = jax.default_backend() != "gpu"


def dtypes(exact: float) -> list[tuple[jnp.dtype, float]]:
    """Returns each dtype in which kernels are tested, with its bound; ``exact`` is that of float32.

    Programs for GPUs have kernels for bf16 alone, so on a GPU float32 is not tested.
    """
    of_bf16 = [(jnp.bfloat16, 1e-2)]
    return [(jnp.float32, exact), *of_bf16] if INTERPRETED else of_bf16


def lowered(run: Callable[..., Any], operands: tuple[Any, ...], target: str) -> str:
    """Returns the text of a program for a platform (cpu, cuda, tpu), whichever this machine has.

    jax 0.11 lowers kernels for the kind of GPU that the mesh names, and without one for that of this machine.
    """
    device = None
    if target == "cuda" and INTERPRETED:
        device = AbstractDevice("NVIDIA H100 80GB HBM3", 132, "gpu")
    with for_all_platforms(), use_abstract_mesh(AbstractMesh((), (), abstract_device=device)):
        text: str = jax.jit(run).trace(*operands).lower(lowering_platforms=(target,)).as_text()
    return text
