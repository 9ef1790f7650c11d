"""Starts training from another run's transformer, or from a converted public one."""

from pathlib import Path
from typing import Any

import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from rsjax.errors import UserError
from rsjax.models.cogvideox.config import CogVideoXConfig
from rsjax.models.cogvideox.transformer import Architecture, shapes
from rsjax.models.network_settings import check_alike, read_model
from rsjax.progress import note
from rsjax.trainable import Params

# Settings that the parameters do not depend on, or that are compared below.
FREE = {"autoencoder", "text", "image", "image_dropout", "stretch", "learned_positions", "compute_dtype", "remat"}
FREE |= {"unroll", "error_weight", "noise", "sample"}


def saved_architecture(saved: CogVideoXConfig) -> Architecture:
    """Returns a network whose parameters are those of saved settings; without learned positions it suits any clips."""
    frames, rows, columns = saved.learned_positions or (1, 1, 1)
    return Architecture(saved, frames, rows * saved.patch_size, columns * saved.patch_size)


def shapes_of(directory: Path, own: CogVideoXConfig) -> Params:
    """Returns the shapes of the weights in a directory.

    Raises:
        UserError: the weights are missing or of another network; the message names the differing fields.
    """
    saved = read_model(directory, CogVideoXConfig, "world_model")
    check_alike(directory, saved, own, FREE, "model")
    alike: dict[str, tuple[Any, Any]] = {
        "model.autoencoder.latent_channels": (saved.autoencoder.latent_channels, own.autoencoder.latent_channels),
        "model.text.width": (saved.text.width, own.text.width),
    }
    if own.learned_positions:
        alike["model.learned_positions"] = (saved.learned_positions, own.learned_positions)
        alike["model.text.tokens"] = (saved.text.tokens, own.text.tokens)
    if own.image == "first_latent":
        alike["model.image"] = (saved.image, own.image)
    for name, (there, here) in alike.items():
        if there != here:
            raise UserError(f"{directory}: holds another network ({name} is {there} there, {here} here); set it alike")
    if saved.noise != own.noise:
        note(f"{directory}: was trained with model.noise {saved.noise}, this model has {own.noise}")
    if saved.learned_positions and not own.learned_positions:
        note(f"{directory}: its learned positions, of {saved.learned_positions} frames and cells, are left aside")
    return shapes(saved_architecture(saved))


def completed(fresh: Params, saved: Params) -> Params:
    """Returns the saved parameters, in the form of the fresh ones.

    If the saved network lacks the channels for an image, they begin at zero. If the learned tokens do not fit, fresh
    ones take their place.
    """
    own = flatten_dict(fresh)
    there = flatten_dict(saved)
    patches = ("patches", "kernel")
    if lacking := own[patches].shape[2] - there[patches].shape[2]:
        there[patches] = np.pad(there[patches], ((0, 0), (0, 0), (0, lacking), (0, 0)))
    fitting = {path: there[path] for path, x in own.items() if path in there and there[path].shape == x.shape}
    return unflatten_dict(own | fitting)
