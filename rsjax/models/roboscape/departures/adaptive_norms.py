"""Actions change the norms of every block and gate its layers, instead of being added to the features once.

The paper adds them for the sake of efficiency. Asked what that means (W8), the authors say that feature modulation
costs more, but not what it would gain. This is such a modulation, the adaptive norms of diffusion transformers (adaLN,
Peebles and Xie 2023, arXiv 2212.09748), with one condition a frame. ``model.action_encoder`` "norms" chooses it.

Axes: B clips, T frames, S cells, C width.
"""

import flax.linen as nn
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from rsjax.layers.dense import Dense, normalised
from rsjax.layers.parameters import Norm


@struct.dataclass
class Change:
    """An action's change of one layer f of a block: x += (1 + gate)·f(norm(x)·(1 + scale) + shift).

    A layer without a norm before it has neither scale nor shift.
    """

    gate: Float[Array, "B T 1 C"]
    scale: Float[Array, "B T 1 C"] | None = None
    shift: Float[Array, "B T 1 C"] | None = None

    def before(self, x: Float[Array, "B T S C"], norm: Norm | None) -> Float[Array, "B T S C"]:
        """Returns what the layer reads, given the parameters of its norm."""
        if norm is None or self.scale is None or self.shift is None:
            return x
        return (normalised(x, norm) * (1 + self.scale) + self.shift).astype(x.dtype)

    def after(self, out: Float[Array, "B T S C"]) -> Float[Array, "B T S C"]:
        """Returns the layer's output as the features receive it."""
        return (out * (1 + self.gate)).astype(out.dtype)


class ActionNorms(nn.Module):
    """One linear layer on the embedded actions: the changes of a block's layers over space, over time and of its MLP.

    It begins at zero, so that a block is at first what it is without actions. (In adaLN-Zero the gates begin at zero
    instead, which would cost a model that starts from public weights their logits.)

    Attributes:
        width: C.
        over_time: whether the layer over time has a norm before it.
        bf16: whether products may round their operands to bf16.
    """

    width: int
    over_time: bool
    bf16: bool

    @nn.compact
    def __call__(self, actions: Float[Array, "B T 1 C"]) -> tuple[Change, Change, Change]:
        count = changes(self.over_time)
        linear = Dense(count * self.width, self.bf16, kernel_init=nn.initializers.zeros, name="linear")
        parts = jnp.split(linear(nn.silu(actions)), count, axis=-1)
        return Change(*parts[:3]), Change(*parts[6:]), Change(*parts[3:6])


def changes(over_time: bool) -> int:
    """Returns how many vectors of the width a block reads from a frame's action."""
    return 9 if over_time else 7
