"""RoboScape's training objective (paper Eq. 4 to 8), term by term.

Each term is a sum over cells or keypoints and the number of them; :func:`rsjax.training.step.combine` divides, and adds
the terms up by their weights λ (Eq. 8). Where Eq. 4 and 7 sum over frames, the sums here run over the masked cells, the
only ones that the network has to predict.

A new term is a line in :func:`loss_terms` and a field ``NAME_weight`` in :class:`rsjax.config.LossConfig`.

Axes: B clips, T frames, H×W = S cells, n vocabularies of V codes, D code bits, A numbers of an action, N tracks of a
clip, K of them keypoints.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Int32

from rsjax import clip
from rsjax.config import RoboScapeConfig, TokenModelConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures.keypoint_terms import other_keypoint_term
from rsjax.models.roboscape.departures.normalised_attention import moved_by_others, normalised
from rsjax.models.roboscape.departures.observed_anchor import anchor
from rsjax.models.roboscape.departures.second_view import SECOND, WEIGHT
from rsjax.models.roboscape.departures.visible_keypoints import counted_frames
from rsjax.tokenizers import lfq
from rsjax.trainable import Term


@struct.dataclass
class Batch:
    """Tokenized clips for a training step.

    Attributes:
        rgb: token of each cell, little-endian, 0 … 2^D - 1.
        depth: token of each cell of the colourised depth map, likewise.
        actions: inputs of the action encoder (:meth:`rsjax.data.normalization.Normalization.action_inputs`); row t led
            into frame t.
        tracks: as in :class:`rsjax.clip.Clip`.
        visible: as in :class:`rsjax.clip.Clip`.
        weight: 1 for a clip that counts, 0 for padding.
        index: the clip's place in the global batch, which decides its random masks whichever device it is on.
        has_depth: 1 for a clip with depth, 0 for one without, whose depth tokens are zeros and never read; None: all
            clips have depth.
        second: token of each cell of the second view; None: the clips have none.
        state: the labels of the state heads (:func:`rsjax.data.state_labels.state_labels`); None: the model has none.
    """

    rgb: Int32[clip.Array, "B T H W"]
    depth: Int32[clip.Array, "B T H W"]
    actions: Float[clip.Array, "B T A"]
    tracks: Float[clip.Array, "B N T 2"]
    visible: Bool[clip.Array, "B N T"]
    weight: Float[clip.Array, " B"]
    index: Int32[clip.Array, " B"]
    has_depth: Float[clip.Array, " B"] | None = None
    state: Float[clip.Array, "B T 3"] | None = None
    second: Int32[clip.Array, "B T H W"] | None = None


@struct.dataclass
class Keypoints:
    """Selected tracks on the token grid."""

    cells: Int[Array, "B K T"]  # row·W + column of the nearest cell
    visible: Bool[Array, "B K T"]  # the frames in which the point counts


def loss_terms(
    config: TokenModelConfig,
    architecture: Architecture,
    logits: dict[str, Float[Array, "B T S n V"]],
    targets: dict[str, Int[Array, "B T H W"]],
    mask: Bool[Array, "B T H W"],
    batch: Batch,
    trunk: Float[Array, "B T S C"] | None = None,
    motion: Float[Array, "B T S 3"] | None = None,
) -> dict[str, Term]:
    """Returns (weighted sum, weight) of every term that is on.

    Args:
        logits: of every cell, by branch.
        targets: the true tokens, by branch.
        mask: the masked cells, in both branches.
        batch: the clips. Those of weight 0 count nowhere, those without depth not in the depth term.
        trunk: the RGB branch's features, for the keypoint term "feature".
        motion: the motion head's outputs, for the keypoint term "motion".
    """
    bits = architecture.code_bits
    grid = architecture.grid
    departures = config.departures
    terms: dict[str, Term] = {}

    # Eq. 4: L_RGB = -Σ_t s_t log p(ŝ_t), and L_Depth alike from z_t.
    nats = lfq.token_cross_entropy(logits["rgb"], targets["rgb"], bits)
    masked = mask * batch.weight[:, None, None, None]
    terms["rgb"] = jnp.sum(nats * masked), jnp.sum(masked)
    if "depth" in logits:
        depth_nats = lfq.token_cross_entropy(logits["depth"], targets["depth"], bits)
        clips = batch.weight
        if batch.has_depth is not None:
            clips = clips * batch.has_depth
        masked_depth = mask * clips[:, None, None, None]
        terms["depth"] = jnp.sum(depth_nats * masked_depth), jnp.sum(masked_depth)
    if SECOND in logits:
        second_nats = lfq.token_cross_entropy(logits[SECOND], targets[SECOND], bits)
        terms[SECOND] = jnp.sum(second_nats * masked), jnp.sum(masked)

    if isinstance(config, RoboScapeConfig) and config.loss.keypoints != "none":
        # T_sample: the K tracks of the largest M_i, on the token grid.
        count = min(config.loss.num_keypoints, batch.tracks.shape[1])
        keypoints = select(batch.tracks, counted_frames(departures, batch.visible), count, grid)
        if config.keypoint_term == "printed":
            # Eq. 5: L_Keypoint = 1/((T-1)K) Σ_i Σ_t≥2 ‖ŝ_t(p_i^t) - ŝ_1(p_i^1)‖².
            cells = keypoints.cells.swapaxes(1, 2)  # B T K
            s_hat = lfq.mean_codes(logits["rgb"], bits)  # B T S D
            first = anchor(departures, s_hat, targets["rgb"])
            distance = keypoint_distance(s_hat, first, cells)
            counts = keypoints.visible.swapaxes(1, 2)[:, 1:] * batch.weight[:, None, None]
            terms["keypoint"] = jnp.sum(distance * counts), jnp.sum(counts)
        elif config.keypoint_term != "none":
            points, visible = (x.swapaxes(1, 2) for x in most_active(batch.tracks, batch.visible, count))
            sample = (grid * points, token_cells(points, grid), visible, batch.weight)
            terms["keypoint"] = other_keypoint_term(config, bits, logits["rgb"], targets["rgb"], *sample, trunk, motion)

        # Eq. 6 and 7: L_Attention = -Σ_t A_t ⊙ s_t log p(ŝ_t). It is divided by the number of cells, not by Σ A.
        marked = keypoints
        if config.loss.attention == "contact":
            touched = moved_by_others(batch.tracks, batch.visible, grid)
            marked = select(batch.tracks, touched, count, grid)
        attention = attention_map(marked, grid, config.loss.gamma)
        if config.loss.attention == "printed":
            terms["attention"] = jnp.sum(nats * attention * masked), jnp.sum(masked)
        else:
            terms["attention"] = normalised(nats, attention, masked)

    weights = loss_weights(config, architecture)
    return {name: term for name, term in terms.items() if name in weights}


def loss_weights(config: TokenModelConfig, architecture: Architecture) -> dict[str, float]:
    """Returns the weight of each term that is on by name."""
    weights = dict(config.loss_weights)
    if architecture.second_view:
        weights[SECOND] = WEIGHT
    return weights


def keypoint_distance(
    s_hat: Float[Array, "B T S D"], first: Float[Array, "B 1 S D"], cells: Int[Array, "B T K"]
) -> Float[Array, "B T-1 K"]:
    """Returns ‖ŝ_t(p_i^t) - ŝ_1(p_i^1)‖² of each keypoint in every frame t ≥ 2.

    Args:
        s_hat: ŝ, the mean codes under the predicted probabilities.
        first: the codes of the first frame to align with.
        cells: the keypoints' cells.
    """
    later = jnp.take_along_axis(s_hat[:, 1:], cells[:, 1:, :, None], axis=2)
    anchors = jnp.take_along_axis(first, cells[:, :1, :, None], axis=2)
    return jnp.sum(jnp.square(later - anchors), axis=-1)


def motion_magnitude(tracks: Float[Array, "*B N T 2"], visible: Bool[Array, "*B N T"]) -> Float[Array, "*B N"]:
    """Returns M_i = Σ_t ‖p_i^{t+1} - p_i^t‖₂ over the steps where the point counts before and after."""
    # The norm's gradient at 0 is undefined, which is harmless: no gradient flows through tracks.
    steps = jnp.linalg.norm(tracks[..., 1:, :] - tracks[..., :-1, :], axis=-1)
    return jnp.sum(steps * (visible[..., 1:] & visible[..., :-1]), axis=-1)


def token_cells(tracks: Float[Array, "*B 2"], grid: int) -> Int[Array, "*B"]:
    """Returns the index (row·grid + column) of the nearest cell; points outside the image go to its edge."""
    column, row = (jnp.clip(jnp.floor(tracks[..., i] * grid), 0, grid - 1).astype(jnp.int32) for i in (0, 1))
    return row * grid + column


def select(tracks: Float[Array, "B N T 2"], visible: Bool[Array, "B N T"], count: int, grid: int) -> Keypoints:
    """Returns T_sample, the ``count`` tracks that move most, on the token grid.

    Args:
        visible: the frames in which each point counts.
    """
    moving, counted = most_active(tracks, visible, count)
    return Keypoints(token_cells(moving, grid), counted)


def most_active(
    tracks: Float[Array, "B N T 2"], visible: Bool[Array, "B N T"], count: int
) -> tuple[Float[Array, "B K T 2"], Bool[Array, "B K T"]]:
    """Returns the ``count`` tracks of the largest M_i, and the frames in which each of them counts."""
    _, chosen = jax.lax.top_k(motion_magnitude(tracks, visible), count)
    take = jax.vmap(lambda values, indices: values[indices])
    return take(tracks, chosen), take(visible, chosen)


def attention_map(keypoints: Keypoints, grid: int, gamma: float) -> Float[Array, "B T H W"]:
    """Returns the map of Eq. 6: γ in the cells that a selected track passes through while visible, 1 elsewhere."""
    b, _, t = keypoints.cells.shape
    cells = jnp.where(keypoints.visible, keypoints.cells, grid**2)  # hidden points go to a spare cell
    hit = jnp.zeros((b, t, grid**2 + 1), bool)
    hit = hit.at[jnp.arange(b)[:, None, None], jnp.arange(t)[None, None], cells].set(True)
    return jnp.where(hit[..., :-1], gamma, 1.0).reshape(b, t, grid, grid)
