"""Linear layers and LayerNorm as in the public PyTorch code."""

from typing import Any, TypeAlias

import flax.linen as nn
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from rsjax.layers.parameters import EPSILON, Norm, parameter
from rsjax.layers.platform import linear, norm_linear

Params: TypeAlias = dict[str, Any]  # a tree of arrays

# torch's default for linear layers, U(±1/√fan_in), as in the public code.
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

    def __call__(self, x: Float[Array, "*N K"], norm: Norm | None = None) -> Float[Array, "*N M"]:
        """Returns the layer's output for x, or for the LayerNorm of x with these parameters."""
        parameters = self.parameters(x.shape[-1])
        if norm is None:
            return dense(x, *parameters, self.bf16)
        return norm_dense(x, norm, *parameters, self.bf16)

    @nn.compact
    def parameters(self, inputs: int) -> tuple[Float[Array, "K M"], Any]:
        """Returns kernel and bias, which may be None, for a function that does more than this layer."""
        kernel = parameter(self, "kernel", self.kernel_init, (inputs, self.features))
        if not self.use_bias:
            return kernel, None
        return kernel, parameter(self, "bias", nn.initializers.zeros, (self.features,))


class NormParameters(nn.Module):
    """Scale and bias of a LayerNorm, for a function that does more than the norm."""

    @nn.compact
    def __call__(self, width: int) -> tuple[Float[Array, " C"], Float[Array, " C"]]:
        scale = parameter(self, "scale", nn.initializers.ones, (width,))
        return scale, parameter(self, "bias", nn.initializers.zeros, (width,))


def dense(
    x: Float[Array, "*N K"], kernel: Float[Array, "K M"], bias: Float[Array, " M"] | None, bf16: bool
) -> Float[Array, "*N M"]:
    """Returns the output of :class:`Dense` with these parameters."""
    return checkpoint_name(_dense(x, kernel, bias, bf16), PRODUCT)


def _dense(x: Array, kernel: Array, bias: Array | None, bf16: bool) -> Array:
    if bf16:
        return linear(x.reshape(-1, x.shape[-1]), kernel, bias).reshape(*x.shape[:-1], kernel.shape[1])
    return x @ kernel if bias is None else x @ kernel + bias


def norm_dense(
    x: Float[Array, "*N K"], norm: Norm, kernel: Float[Array, "K M"], bias: Float[Array, " M"] | None, bf16: bool
) -> Float[Array, "*N M"]:
    """Returns :func:`dense` of the LayerNorm of x."""

    def layers(x: Array, norm: Norm, kernel: Array) -> Array:
        return _dense(normalised(x, norm), kernel, bias, bf16)

    if bf16 and bias is None:
        out = norm_linear(x, norm, kernel, layers)
    else:
        out = layers(x, norm, kernel)
    return checkpoint_name(out, PRODUCT)


def normalised(x: Float[Array, "*N C"], norm: Norm) -> Float[Array, "*N C"]:
    """Returns the LayerNorm of x with these parameters, in the number format of x; its statistics are float32."""
    parameters = dict(zip(("scale", "bias"), norm, strict=True))
    normed: Any = nn.LayerNorm(EPSILON, x.dtype, parent=None).apply({"params": parameters}, x)
    return normed


def rounded(params: Params, biases: tuple[str, ...] = ()) -> Params:
    """Rounds the kernels of linear layers to bf16, as they do themselves in every pass but on CPUs without bf16 units.

    Args:
        biases: names of layers whose biases are rounded too, as :func:`rsjax.layers.accelerator.linear` does for bf16
            features.
    """
    if "kernel" in params:
        return params | {"kernel": params["kernel"].astype(jnp.bfloat16)}
    if "scale" in params:
        return params
    tree = {name: rounded(inner, biases) for name, inner in params.items()}
    for name in tree.keys() & biases:
        tree[name] |= {"bias": tree[name]["bias"].astype(jnp.bfloat16)}
    return tree


def layer_norm(name: str | None, dtype: Any = jnp.float32) -> nn.LayerNorm:
    """Returns a LayerNorm with float32 statistics, whose output has this number format."""
    return nn.LayerNorm(epsilon=EPSILON, dtype=dtype, name=name)
