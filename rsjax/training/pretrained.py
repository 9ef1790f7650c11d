"""A tokenizer or a world model by the name of its directory, and starting to train from one.

A directory holds either or both, laid out as a run directory: ``config.json`` with the sections ``tokenizer`` and
``model``, weights under ``tokenizer/weights`` and ``world_model/weights``. So finished runs are such directories too.
"""

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict, unflatten_dict

from rsjax.config import ConfigError, ModelConfig, TokenizerConfig, from_dict, to_dict
from rsjax.errors import UserError
from rsjax.files import disk_guard, write_atomically
from rsjax.models.roboscape.world_model import WorldModel
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.training.checkpoint import load_weights, save_weights

C = TypeVar("C", bound=TokenizerConfig | ModelConfig)


class PartError(UserError):
    """A directory without the wanted part, or with another network's. The message names it and the cure."""


class _Kind(NamedTuple):
    section: str  # of config.json
    weights: str  # place in the directory
    init: Callable[[Any], Callable[[Any], Any]]  # configuration → key → fresh parameters
    free: frozenset[str]  # fields that may differ between the weights' configuration and that of the training


KINDS: dict[type, _Kind] = {
    TokenizerConfig: _Kind(
        "tokenizer",
        "tokenizer/weights",
        lambda config: Tokenizer(config).init_params,
        frozenset({"image_size", "vocabularies", "depth_scale"}),
    ),
    ModelConfig: _Kind(
        "model",
        "world_model/weights",
        lambda config: WorldModel(config).init_params,
        frozenset(
            {"depth", "action_dim", "integrate_actions", "action_dropout", "compute_dtype", "embed_std", "position_std"}
            | {field.name for field in fields(ModelConfig) if field.metadata.get("runtime")}
        ),
    ),
}


def save_part(directory: Path, config: TokenizerConfig | ModelConfig, params: Any) -> None:
    """Writes a tokenizer or a world model; another part in the directory is kept, the same one replaced.

    Raises:
        PartError: the directory is a run's, whose weights were trained there.
        StoreError: the disk is full.
    """
    kind, path = KINDS[type(config)], directory / "config.json"
    sections = _read(path) if path.exists() else {}
    if sections.keys() - {k.section for k in KINDS.values()}:
        raise PartError(f"{directory}: is a run directory; choose another one")
    with disk_guard(directory):
        (directory / kind.weights).parent.mkdir(parents=True, exist_ok=True)
        # Stopped in between, there is no such part rather than one network's settings beside another's weights.
        if sections.pop(kind.section, None) is not None:
            write_atomically(path, _text(sections))
        save_weights(directory / kind.weights, params)
        write_atomically(path, _text(sections | {kind.section: to_dict(config)}))


def has_part(directory: Path, kind: type) -> bool:
    """Whether the directory holds weights of this kind."""
    return (directory / KINDS[kind].weights).exists()


def check_part(directory: Path, kind: type) -> None:
    """Raises :class:`PartError` where the directory does not hold weights of this kind with their settings."""
    known = KINDS[kind]
    if known.section not in _read(directory / "config.json") or not has_part(directory, kind):
        raise PartError(f"{directory}: holds no {known.weights} with its settings in config.json")


def load_part(directory: Path, kind: type[C]) -> tuple[C, Any]:
    """The configuration and parameters of the directory's tokenizer or world model.

    Raises:
        PartError: the directory has none, or its settings are damaged or of another version.
        CheckpointError: its weights are damaged.
    """
    known = KINDS[kind]
    path = directory / "config.json"
    check_part(directory, kind)
    try:
        config = from_dict(kind, _read(path)[known.section])
    except ConfigError as error:
        raise PartError(f"{path}: {known.section} cannot be read ({error}); make it again") from error
    return config, load_weights(directory / known.weights, jax.eval_shape(known.init(config), jax.random.key(0)))


def start_tokenizer(config: TokenizerConfig, directory: Path, fresh: Any) -> Any:
    """The parameters that training begins with: the directory's tokenizer; a discriminator stays fresh.

    Args:
        fresh: parameters as the objective makes them.

    Raises:
        PartError: the directory has no tokenizer, or that of another network; the message names what differs.
    """
    saved = _load_same(config, directory)
    return fresh | {"generator": saved} if "generator" in fresh else saved


def start_world_model(config: ModelConfig, directory: Path, fresh: Any) -> Any:
    """The parameters that training begins with: the directory's world model, to the letter where it has them.

    What it lacks stays fresh (the depth branch) or begins at zero (the depth → RGB projection, the action encoder), so
    that the logits of RGB are those of the directory's model until training changes them. An action encoder that it has
    is taken as it is: it sees actions in the units of the data at hand.

    Args:
        fresh: parameters as the objective makes them.

    Raises:
        PartError: the directory has no world model, or that of another network; the message names what differs.
    """
    saved, own = (flatten_dict(tree, sep="/") for tree in (_load_same(config, directory), fresh))
    for path in saved:
        if path not in own:
            raise PartError(f"{directory}: its {path} has no place in this model; keep the branches and the actions")
        if saved[path].shape != own[path].shape:
            raise PartError(f"{directory}: its {path} is {saved[path].shape}, this model's is {own[path].shape}")
    for path, x in own.items():
        if path not in saved:
            saved[path] = jnp.zeros_like(x) if _joins_rgb(path) else x
    return unflatten_dict(saved, sep="/")


def _joins_rgb(path: str) -> bool:
    return path.startswith(("blocks/depth_to_rgb/", "action_encoder/", "null_action"))


def _load_same(config: TokenizerConfig | ModelConfig, directory: Path) -> Any:
    there, params = load_part(directory, type(config))
    free = KINDS[type(config)].free
    if isinstance(there, ModelConfig) and there.action_dim:
        free -= {"integrate_actions"}  # what its action encoder was trained to see
    names = [field.name for field in fields(config) if field.name not in free]
    differing = [n for n in names if getattr(there, n) != getattr(config, n)]
    if differing:
        told = "; ".join(f"{n} is {getattr(there, n)} there, {getattr(config, n)} here" for n in differing)
        section = KINDS[type(config)].section
        raise PartError(f"{directory}: holds another network ({told}); set these fields of {section} alike")
    return params


def _text(sections: dict[str, Any]) -> bytes:
    return json.dumps(sections, indent=1).encode()


def _read(path: Path) -> dict[str, Any]:
    try:
        sections = json.loads(path.read_text())
    except OSError as error:
        raise PartError(f"{path}: cannot be read ({error.strerror}); make it with python -m rsjax.convert") from error
    except ValueError as error:
        raise PartError(f"{path}: not JSON ({error}); delete it and make it again") from error
    if not isinstance(sections, dict):
        raise PartError(f"{path}: holds no settings by name; delete it and make it again")
    return sections
