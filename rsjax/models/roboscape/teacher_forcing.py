"""Teacher forcing: predicts the tokens of each frame, all masked, from the true frames before it.

The true frames are encoded into the temporal cache once; then each frame takes one pass over its masked cells, which
reads the cache slots before its own. Clips that are longer than the positions are scored window by window, as they are
generated in a rollout.

Axes: B clips, T frames, H×W = S cells, A action dimensions.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from rsjax.clip import Array
from rsjax.config import SampleConfig
from rsjax.models.base import TeacherForced
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures.read_previous import frame_before
from rsjax.models.roboscape.maskgit import sample_tokens
from rsjax.models.roboscape.sample import cache_slots, read_state, sums_before, window_actions, window_start
from rsjax.models.roboscape.transformer import empty_cache, run_transformer, run_with_trunk
from rsjax.tokenizers import lfq
from rsjax.trainable import Params

Tokens = dict[str, Int[Array, "B T H W"]]
Scores = dict[str, Float[Array, "B T"]]


def score_tokens(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    tokens: Tokens,
    actions: Float[Array, "B T A"],
    no_depth: Bool[np.ndarray, " B"],
    past: int,
    resting: Float[Array, " A"] | None = None,
) -> TeacherForced:
    """Predicts each frame after the prompt from all true frames before it.

    Args:
        sample: sets the stride of the window.
        tokens: of the true frames, by branch; "depth" is zeros for clips without.
        actions: normalised; row t led into frame t.
        no_depth: True for clips without depth.
        past: prompt frames, which are not scored.
        resting: as :func:`rsjax.models.roboscape.sample.resting_actions` returns them.
    """
    frames = actions.shape[1]
    size = frames if arch.departures.rotary else arch.frames
    starts = [int(window_start(arch, sample, t)) for t in range(frames)]
    parts = []
    for base in dict.fromkeys(starts[past:]):
        window = {name: _window(grid, base, size) for name, grid in tokens.items()}
        rows = _window(actions, base, size)
        rows = window_actions(arch, rows, sums_before(rows[:, 0], base, resting), 0)
        scores = _score_window(replace(arch, unroll=1), params, window, rows, no_depth)
        scored = [t - base for t in range(past, frames) if starts[t] == base]
        parts.append(jax.tree.map(lambda x, scored=scored: np.asarray(x)[:, scored], scores))
    nats, right, features, state = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *parts)
    if "depth" in nats:
        for scores in (nats, right):
            scores["depth"][no_depth] = np.nan
    return TeacherForced(nats, right, features, state)


def _window(x: Array, start: int, size: int) -> Array:
    """Returns ``size`` frames from ``start`` on, padded with zeros where there are none."""
    x = jnp.asarray(x)[:, start : start + size]
    return jnp.pad(x, [(0, 0), (0, size - x.shape[1]), *[(0, 0)] * (x.ndim - 2)])


@partial(jax.jit, static_argnums=0)
def _score_window(
    arch: Architecture, params: Params, tokens: Tokens, actions: Float[Array, "B T A"], no_depth: Bool[Array, " B"]
) -> tuple[Scores, Scores, Float[Array, "B T C"], Float[Array, "B T K"] | None]:
    """Returns cross-entropy and accuracy of each frame's tokens by branch, features and what the state heads read.

    Frame 0 is predicted from none.
    """
    clips, frames = actions.shape[:2]
    visible = jnp.zeros((clips, frames, arch.grid, arch.grid), bool)
    empty = empty_cache(arch, clips, cache_slots(arch, frames + arch.uncommitted))
    _, cache = run_transformer(arch, params, tokens, visible, actions, 0, empty, no_depth=no_depth)
    before = {name: frame_before(grid.reshape(clips, frames, -1)) for name, grid in tokens.items()}

    def score(t: Array) -> tuple[Scores, Scores, Float[Array, "B C"], Float[Array, "B K"] | None]:
        frame = {name: jax.lax.dynamic_slice_in_dim(grid, t, 1, axis=1) for name, grid in tokens.items()}
        action = jax.lax.dynamic_slice_in_dim(actions, t, 1, axis=1)
        previous = {name: jax.lax.dynamic_slice_in_dim(cells, t, 1, axis=1) for name, cells in before.items()}
        inputs = (frame, ~visible[:, :1], action, t, cache)
        logits, _, trunk = run_with_trunk(arch, params, *inputs, no_depth=no_depth, previous=previous)
        likeliest = {
            name: sample_tokens(jax.random.key(0), x, 0.0, arch.code_bits)[0].reshape(frame[name].shape)
            for name, x in logits.items()
        }
        nats = {name: lfq.token_cross_entropy(x, frame[name], arch.code_bits) for name, x in logits.items()}
        right = {name: (grid == frame[name]).astype(jnp.float32) for name, grid in likeliest.items()}
        nats, right = jax.tree.map(lambda x: x.mean((1, 2, 3)), (nats, right))
        return nats, right, trunk[:, 0].mean(1), read_state(arch, params, trunk)

    return jax.vmap(score, out_axes=1)(jnp.arange(frames))
