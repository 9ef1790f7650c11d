"""Starts training from the weights of another run or of a converted public checkpoint.

Both directories contain ``config.json`` and ``world_model/weights``. A run's ``config.json`` is its configuration; a
converted checkpoint's has a section ``architecture`` instead.
"""

from dataclasses import fields
from pathlib import Path

import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict, unflatten_dict

from rsjax.config import Config, ConfigError, Departures, GenieConfig, RoboScapeConfig, TransformerConfig, from_dict
from rsjax.config.fields import differences
from rsjax.errors import UserError
from rsjax.model_directory import has_weights, read_settings
from rsjax.models.network_settings import check_family
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures.second_view import SECOND
from rsjax.models.roboscape.transformer import Transformer
from rsjax.trainable import Params

# Departures in which the saved network and the one to train must agree; other departures may differ.
ALIKE = {"read_previous", "whole_frames", "rotary", "more_norms"}
# Parameters whose outputs are added to the RGB branch's features; and those of a model with a depth head.
JOINING: tuple[str, ...] = ("blocks/depth_to_rgb/", "action_encoder/", "action_encoder_fc2/", "null_action")
ADAPTIVE = "/action_norms/"
HEAD_JOINING = ("depth_embed/", "depth_previous_embed/")
SECOND_JOINING = (f"{SECOND}_embed/", f"{SECOND}_previous_embed/")
# Parameters that are left out where this model lacks them.
OPTIONAL = {"motion_head", "state_heads", "null_action", "depth_null_action"}
# Fields that may differ.
FREE = {"action_encoder", "action_inputs", "motion_head", "state_heads", "one_start", "departures"} | {
    "compute_dtype",
    "feature_dtype",
    *(field.name for field in fields(TransformerConfig) if field.metadata.get("runtime")),
}


def read_architecture(directory: Path) -> Architecture:
    """Returns the architecture of a directory's world model.

    Raises:
        UserError: the settings are missing, damaged, of another version or of another family.
    """
    path = directory / "config.json"
    settings = read_settings(directory, "make it with rsjax convert")
    check_family(path, settings, (RoboScapeConfig.family, GenieConfig.family))
    if not settings.keys() & {"architecture", "model"}:
        raise UserError(f"{directory}: holds no world_model/weights with their settings in config.json")
    try:
        if "architecture" in settings:
            return from_dict(Architecture, settings["architecture"])
        config = from_dict(Config, settings)
    except (ConfigError, TypeError) as error:
        raise UserError(f"{path}: the world model's settings cannot be read ({error}); make it again") from error
    return Architecture.create(config)


def shapes(own: Architecture, directory: Path) -> Params:
    """Returns the shapes of the directory's weights.

    Raises:
        UserError: the weights are missing or of another network; the message names the differing fields.
    """
    if not has_weights(directory, "world_model"):
        raise UserError(f"{directory}: holds no world_model/weights with their settings in config.json")
    saved = read_architecture(directory)
    # A trained action encoder needs the same inputs.
    free = FREE
    alike = ALIKE
    if saved.action_inputs:
        free = FREE - {"action_encoder"}
        alike = ALIKE | {"integrate_actions"}
    if saved.depth == "none":
        free = free | {"depth", "reads_depth", "depth_width", "depth_blocks", "depth_cells"}
    if not saved.second_view:
        free = free | {"second_view"}
    other = {field.name for field in fields(Departures)} - alike
    differing = "; ".join(
        filter(None, [differences(saved, own, free), differences(saved.departures, own.departures, other)])
    )
    if differing:
        raise UserError(f"{directory}: holds another network ({differing}); set these alike")
    return jax.eval_shape(Transformer(saved).init_params, jax.random.key(0))


def start(fresh: Params, saved: Params, directory: Path) -> Params:
    """Returns the parameters that training begins with: the saved ones, unchanged, completed by fresh ones.

    What joins the RGB branch begins at zero: the depth → RGB projection or, with a depth head, the embeddings of depth,
    those of a second view, and the action encoder's last layer, or what adaptive norms read from it. So RGB logits are
    at first those of the saved model. A saved action encoder is kept; it reads actions normalised for the new data.
    Saved motion heads, state heads or null actions that this model lacks are left out.

    Raises:
        UserError: this model lacks a saved array, or has it in another shape.
    """
    own = flatten_dict(fresh, sep="/")
    lacking = OPTIONAL - fresh.keys()
    saved = {name: part for name, part in saved.items() if name not in lacking}
    params = _grouped(flatten_dict(saved, sep="/"), own)
    for path in params:
        if path not in own:
            raise UserError(f"{directory}: its {path} has no place in this model; keep the branches and the actions")
        if params[path].shape != own[path].shape:
            raise UserError(f"{directory}: its {path} is {params[path].shape}, this model's is {own[path].shape}")
    joining = JOINING + SECOND_JOINING
    if not any(path.startswith("blocks/depth/") for path in own):
        joining += HEAD_JOINING
    if any(ADAPTIVE in path for path in own):  # a layer on an encoder of zeros would not learn
        joining = tuple(prefix for prefix in joining if prefix != "action_encoder/")
    for path, x in own.items():
        joins = path.startswith(joining) or (path.startswith("blocks/rgb") and ADAPTIVE in path)
        if path not in params:
            params[path] = jnp.zeros_like(x) if joins else x
    return unflatten_dict(params, sep="/")


def _grouped(params: dict[str, jax.Array], own: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Divides the stack of RGB blocks as this model does, if its depth branch has fewer blocks (``more_rgb``)."""
    names = sorted({path.split("/")[1] for path in own if path.startswith("blocks/rgb")})  # rgb, rgb_1, …
    if len(names) == 1 or any(path.startswith("blocks/rgb_1/") for path in params):
        return params
    grouped = {}
    for path, x in params.items():
        if not path.startswith("blocks/rgb/"):
            grouped[path] = x
            continue
        for name in names:
            first = int(name.removeprefix("rgb").removeprefix("_") or 0)
            grouped[path.replace("blocks/rgb/", f"blocks/{name}/")] = x[first :: len(names)]
    return grouped
