"""Where kernels run in tests: on a GPU if there is one, and otherwise in Pallas' interpreter, slowly."""

import jax
import jax.numpy as jnp

INTERPRETED = jax.default_backend() != "gpu"


def dtypes(exact: float) -> list[tuple[jnp.dtype, float]]:
    """Returns each dtype in which kernels are tested, with its bound; ``exact`` is that of float32.

    Programs for GPUs have kernels for bf16 alone, so on a GPU float32 is not tested.
    """
    of_bf16 = [(jnp.bfloat16, 1e-2)]
    return [(jnp.float32, exact), *of_bf16] if INTERPRETED else of_bf16
