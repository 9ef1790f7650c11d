"""Where kernels run in tests: on a GPU if there is one, and otherwise in Pallas' interpreter, slowly."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import AbstractDevice, AbstractMesh, use_abstract_mesh

from rsjax.layers.platform import for_all_platforms

INTERPRETED = jax.default_backend() != "gpu"


def in_dtypes(cases: Sequence[tuple[Any, ...]], exact: float, interpreted: bool = INTERPRETED) -> list[tuple[Any, ...]]:
    """Returns the cases in which kernels are tested, each with a dtype and its bound; ``exact`` is that of float32.

    Programs for GPUs have kernels for bf16 alone, so on a GPU all cases are in bf16. The slow interpreter runs them in
    float32, and the first in bf16 too.
    """
    bf16 = (jnp.bfloat16, 1e-2)
    if not interpreted:
        return [(*case, *bf16) for case in cases]
    return [*((*case, jnp.float32, exact) for case in cases), (*cases[0], *bf16)]


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
