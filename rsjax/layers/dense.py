"""Linear layers and LayerNorm as in the public PyTorch code."""

from typing import Any, TypeAlias

import flax.linen as nn
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from rsjax.layers.platform import linear

# torch's default for linear layers, U(±1/√fan_in), as in the public code.
Params: TypeAlias = dict[str, Any]  # a tree of arrays

TORCH_KERNEL = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")
PRODUCT = "product"  # the name of linear layers' outputs in rematerialisation policies


class Dense(nn.Module):
    """A linear layer with float32 parameters, whose output has the number format of its input.

    With ``bf16`` it rounds operands to bf16 and adds up in float32 (:func:`rsjax.layers.platform.linear`).
    """

    features: int
    bf16: bool = False
    use_bias: bool = True
    kernel_init: nn.initializers.Initializer = TORCH_KERNEL

    @nn.compact
    def __call__(self, x: Float[Array, "*N K"]) -> Float[Array, "*N M"]:
        kernel = self.param("kernel", self.kernel_init, (x.shape[-1], self.features))
        bias = self.param("bias", nn.initializers.zeros, (self.features,)) if self.use_bias else None
        if self.bf16:
            out = linear(x.reshape(-1, x.shape[-1]), kernel, bias).reshape(*x.shape[:-1], self.features)
        else:
            out = x @ kernel if bias is None else x @ kernel + bias
        return checkpoint_name(out, PRODUCT)


def rounded(params: Params) -> Params:
    """Rounds linear layers to bf16, as they do themselves in every pass over features in bf16."""
    if "kernel" in params:
        return {name: x.astype(jnp.bfloat16) for name, x in params.items()}
    if "scale" in params:
        return params
    return {name: rounded(inner) for name, inner in params.items()}


def layer_norm(name: str | None, dtype: Any = jnp.float32) -> nn.LayerNorm:
    """Returns a LayerNorm with torch's epsilon and float32 statistics, whose output has this number format."""
    return nn.LayerNorm(epsilon=1e-5, dtype=dtype, name=name)
