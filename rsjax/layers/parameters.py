"""What layers, and the kernels that stand for several of them, are given as parameters."""

from typing import TypeAlias

from jaxtyping import Array, Float

Norm: TypeAlias = tuple[Float[Array, " C"], Float[Array, " C"]]  # scale and bias of a LayerNorm
Linear: TypeAlias = tuple[Float[Array, "M N"], Float[Array, " N"]]  # kernel and bias of a linear layer

EPSILON = 1e-5  # of LayerNorm, as in torch
