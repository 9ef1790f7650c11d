"""Starts training from the weights of another run, or of a converted public checkpoint.

Both directories contain ``config.json`` and weights. The ``config.json`` of a run is its configuration; that of a
converted checkpoint has a section ``kl_autoencoder`` or ``irasim``.
"""

from pathlib import Path
from typing import TypeVar

import jax.numpy as jnp
from flax.traverse_util import flatten_dict, unflatten_dict

from rsjax.config import Config, ConfigError, from_dict
from rsjax.config.fields import differences
from rsjax.errors import UserError
from rsjax.model_directory import Part, has_weights, read_settings
from rsjax.models.irasim.config import IRASimConfig, KLConfig
from rsjax.models.irasim.dit import Architecture, architecture
from rsjax.models.network_settings import check_family
from rsjax.progress import note
from rsjax.trainable import Params

# Sections of config.json.
AUTOENCODER = "kl_autoencoder"
NETWORK = "irasim"
# Fields that may differ between the saved network and the one to train: parameters do not depend on them, or those
# that do begin afresh.
FREE = ("rows", "columns", "action_inputs", "compute_dtype", "unroll", "remat")
C = TypeVar("C")


def saved_autoencoder(directory: Path) -> KLConfig:
    """Returns the settings of a directory's autoencoder.

    Raises:
        UserError: there is no autoencoder, or its settings are missing, damaged or of another family.
    """
    saved = _section(directory, AUTOENCODER, KLConfig, "tokenizer", "sdxl")
    if isinstance(saved, Config):
        return saved.autoencoder
    return saved


def saved_network(directory: Path) -> Architecture:
    """Returns the architecture of a directory's transformer. Errors as in :func:`saved_autoencoder`."""
    saved = _section(directory, NETWORK, Architecture, "world_model", "irasim")
    if isinstance(saved, Config):
        return architecture(saved)
    return saved


def check_autoencoder(directory: Path, own: KLConfig) -> KLConfig:
    """Returns :func:`saved_autoencoder`; also raises UserError if its network differs from ``own``."""
    saved = saved_autoencoder(directory)
    if differing := differences(saved, own, ("kl_weight", "compute_dtype", "depth")):
        raise UserError(
            f"{directory}: holds another autoencoder ({differing}); set these fields of model.autoencoder alike"
        )
    return saved


def check_network(directory: Path, own: Architecture) -> Architecture:
    """Returns :func:`saved_network`; also raises UserError if its network differs from ``own``."""
    saved = saved_network(directory)
    free: tuple[str, ...] = FREE
    if own.conditioning == "frame":
        free = (*free, "frames")
    if own.depth:
        free = (*free, "depth")
    if differing := differences(saved, own, free):
        raise UserError(f"{directory}: holds another network ({differing}); set these fields of model alike")
    if saved.action_inputs != own.action_inputs:
        note(
            f"{directory}: its actions have {saved.action_inputs} numbers, these {own.action_inputs}; the first layer "
            f"of the action encoder begins fresh"
        )
    if saved.depth != own.depth:
        note(f"{directory}: knows no depth; the network's weights for its channels begin at zero")
    return saved


def completed(fresh: Params, saved: Params, arch: Architecture) -> Params:
    """Returns the saved parameters of a network that may have had other actions, or no depth.

    If actions have another length, the action encoder's first layer is a fresh one. The weights of new channels of
    depth are zero, in the first layer and in the last one: the network begins with the noise that it predicts of RGB
    unchanged.
    """
    own = flatten_dict(fresh, sep="/")
    there = flatten_dict(saved, sep="/")
    first = "action_fc1/kernel"
    if there[first].shape != own[first].shape:
        there |= {name: own[name] for name in (first, "action_fc1/bias")}
    if there["patches/kernel"].shape != own["patches/kernel"].shape:
        z = arch.channels
        there["patches/kernel"] = jnp.zeros(own["patches/kernel"].shape).at[:, :, :z].set(there["patches/kernel"])
        for name in ("final/kernel", "final/bias"):
            lead = there[name].shape[:-1]  # the last axis: a patch's cells, then their channels
            noise = there[name].reshape(*lead, arch.patch_size**2, -1)[..., :z]
            empty = jnp.zeros((*lead, arch.patch_size**2, arch.outputs))
            there[name] = empty.at[..., :z].set(noise).reshape(*lead, -1)
    return unflatten_dict(there, sep="/")


def _section(directory: Path, name: str, kind: type[C], stage: Part, command: str) -> C | Config:
    cure = f"make it with rsjax convert {command}"
    if not has_weights(directory, stage):
        raise UserError(f"{directory}: holds no {stage}/weights with their settings in config.json; {cure}")
    path = directory / "config.json"
    settings = read_settings(directory, cure)
    check_family(path, settings, (IRASimConfig.family,))
    if not settings.keys() & {name, "model"}:
        raise UserError(f"{path}: describes no network of IRASim but {', '.join(settings) or 'nothing'}; {cure}")
    try:
        if name in settings:
            return from_dict(kind, settings[name])
        return from_dict(Config, settings)
    except (ConfigError, TypeError) as error:
        raise UserError(f"{path}: the network's settings cannot be read ({error}); make it again") from error
