"""All terms of the world model's objective for one batch (paper Eq. 8)."""

import jax
from jaxtyping import Array

from rsjax.clip import Batch
from rsjax.config import LossConfig, MaskConfig, ModelConfig
from rsjax.models.roboscape import keypoints as kp
from rsjax.models.roboscape import losses, masking
from rsjax.models.roboscape.world_model import WorldModel, branches


def world_model_terms(
    model: ModelConfig, mask: MaskConfig, loss: LossConfig, params: dict, batch: Batch, key: Array
) -> dict[str, losses.Term]:
    """Masks the batch, runs the model, and returns each term's (weighted sum, weight).

    Clips without depth have no part in the depth term, which is (0, 0) where none has it, and all their depth is hidden
    from the model.

    Args:
        key: the step's key; the same on all devices.
    """
    clean = {branch: getattr(batch, branch) for branch in branches(model)}
    given = masking.corrupt(mask, model.code_bits, model.vocabularies, key, clean, batch.index)
    drop = masking.dropped_actions(model.action_dropout, key, batch.index) if model.action_dropout else None
    no_depth = None if batch.has_depth is None else batch.has_depth == 0
    inputs = (given.tokens, given.mask, batch.actions)
    logits, _ = WorldModel(model).apply({"params": params}, *inputs, drop_actions=drop, no_depth=no_depth)
    entropy = {b: losses.token_cross_entropy(logits[b], clean[b], model.code_bits) for b in clean}

    terms = {"rgb": losses.rgb_term(entropy["rgb"], given.mask, batch.weight)}
    if model.depth:
        counts = batch.weight if batch.has_depth is None else batch.weight * batch.has_depth
        terms["depth"] = losses.depth_term(entropy["depth"], given.mask, counts)
    if loss.keypoints:
        points = kp.select(batch.tracks, batch.visible, loss.num_keypoints, model.grid)
        attention = kp.attention_map(points, model.grid, loss.gamma)
        terms["attention"] = losses.attention_term(entropy["rgb"], given.mask, batch.weight, attention)
        predicted = losses.expected_codes(logits["rgb"], model.code_bits)
        terms["keypoint"] = losses.keypoint_term(predicted, points, batch.weight)
    return jax.tree.map(lambda x: x.astype("float32"), terms)
