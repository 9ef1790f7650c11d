"""Heads that read from the RGB branch whether the task is done, how high the object is and how far the gripper is open.

x_t are the features of frame t that RGB's head reads, n_t = LN(x_t). Each quantity k of ``STATE`` looks for its cells:

    y_k,t = Σ_c a_k,t,c · (w_k · n_t,c) + b_k,   a_k,t = softmax_c(q_k · n_t,c).

q begins at 0, so that the heads begin as linear heads on the mean over the cells. Success is σ(y), height and opening
are y in units of ``UNIT``. With the labels v, h and g of the n frames that have them, and the Huber loss H (quadratic
up to ``UNIT``):

    L_success = 1/n Σ_t BCE(σ(y_t), v_t),   L_height = 1/n Σ_t H(y_t - h_t),   L_opening = 1/n Σ_t H(y_t - g_t).

So the features that predict the next frame also have to say whether a grasp holds, and a policy, a planner and an
environment learn it without a second network that looks at generated pictures. iVideoGPT's reward head
(arXiv 2405.15223) is the model: one linear layer on the last token's features, for model-based reinforcement learning.

In training, the features are of frames whose cells are partly masked, as in the passes of sampling. Sampling reads
those of a frame's last pass, which also predicts its tokens, so that the heads cost no pass of their own.

Axes: B clips, T frames, S cells, C width, K quantities.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Float

from rsjax.clip import Array
from rsjax.data.state_labels import STATE
from rsjax.layers.dense import Dense, layer_norm
from rsjax.trainable import Params, Term

UNIT = 0.1  # metres, of height and opening in the heads' outputs
PRODUCTS = 2 * len(STATE)  # linear maps of a cell's features to a number


class StateHeads(nn.Module):
    """A norm, and for each quantity a query that weighs the cells and a linear map."""

    @nn.compact
    def __call__(self, features: Float[Array, "B T S C"]) -> Float[Array, "B T K"]:
        normed = layer_norm("norm")(features)
        queries = Dense(len(STATE), use_bias=False, kernel_init=nn.initializers.zeros, name="query")(normed)
        weights = nn.softmax(queries, axis=2)
        return jnp.sum(weights * Dense(len(STATE), name="out")(normed), axis=2)  # the weights add up to 1, so b stays b


def outputs(params: Params, features: Float[Array, "B T S C"]) -> Float[Array, "B T K"]:
    """Returns y of every frame; ``params`` are those of a whole model with these heads."""
    y: Any = StateHeads().apply({"params": params["state_heads"]}, features)
    return y


def readings(params: Params, features: Float[Array, "B T S C"]) -> Float[Array, "B T K"]:
    """Returns the probability of success, and height and opening in metres, of every frame."""
    y = outputs(params, features)
    return jnp.concatenate([jax.nn.sigmoid(y[..., :1]), UNIT * y[..., 1:]], axis=-1)


def loss_terms(y: Float[Array, "B T K"], labels: Float[Array, "B T K"], weight: Float[Array, " B"]) -> dict[str, Term]:
    """Returns each loss as a sum over frames and their number.

    Args:
        y: the heads' outputs.
        labels: as of :func:`rsjax.data.state_labels.state_labels`; frames without a label (NaN) do not count.
        weight: of each clip.
    """
    known = ~jnp.isnan(labels)
    targets = jnp.where(known, labels, 0.0)
    success = optax.sigmoid_binary_cross_entropy(y[..., :1], targets[..., :1])
    lengths = optax.huber_loss(y[..., 1:], targets[..., 1:] / UNIT)
    counts = known * weight[:, None, None]
    errors = jnp.concatenate([success, lengths], axis=-1) * counts
    return {name: (jnp.sum(errors[..., k]), jnp.sum(counts[..., k])) for k, name in enumerate(STATE)}
