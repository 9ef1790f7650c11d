"""What layers, and the kernels that stand for several of them, are given as parameters."""

from typing import TypeAlias

import flax.linen as nn
from jaxtyping import Array, Float

Norm: TypeAlias = tuple[Float[Array, " C"], Float[Array, " C"]]  # scale and bias of a LayerNorm
Linear: TypeAlias = tuple[Float[Array, "M N"], Float[Array, " N"]]  # kernel and bias of a linear layer

EPSILON = 1e-5  # of LayerNorm, as in torch


def parameter(
    module: nn.Module, name: str, init: nn.initializers.Initializer, shape: tuple[int, ...]
) -> Float[Array, "..."]:
    """Returns ``module.param(name, init, shape)``, in less time where the parameter exists.

    There flax traces the initialiser at every use, to compare shapes: a tenth of the time before a first step.
    """
    if module.has_variable("params", name):
        value: Array = module.get_variable("params", name)
        if value.shape == shape:
            return value
    made: Array = module.param(name, init, shape)
    return made
