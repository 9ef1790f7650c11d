"""Directories of converted checkpoints, laid out as run directories: ``config.json``, and weights beside it.

A directory holds a tokenizer, a world model or both; training starts from it (``start_from``), as from a run.
"""

from pathlib import Path

import jax

from rsjax.config import TokenizerConfig, to_dict
from rsjax.convert.files import ConvertError
from rsjax.files import disk_guard, read_json, write_json
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.pretrained import read_architecture
from rsjax.models.roboscape.transformer import Transformer
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tokenizers.training import read_tokenizer_config
from rsjax.trainable import Params
from rsjax.training.checkpoint import load_weights, save_weights

SECTIONS: dict[type, tuple[str, str]] = {  # section of config.json, and directory of the weights
    TokenizerConfig: ("tokenizer", "tokenizer/weights"),
    Architecture: ("architecture", "world_model/weights"),
}


def save(directory: Path, config: TokenizerConfig | Architecture, params: Params) -> bool:
    """Writes a tokenizer or a world model; the directory's other network is kept, the same one replaced.

    Returns:
        Whether there was one, which it replaced.

    Raises:
        ConvertError: the directory is a run's, whose weights were trained there.
        FileError: the disk is full.
    """
    (section, place), path = SECTIONS[type(config)], directory / "config.json"
    settings = read_json(path) if path.exists() else {}
    if settings.keys() - {name for name, _ in SECTIONS.values()}:
        raise ConvertError(f"{directory}: is a run directory; choose another one")
    with disk_guard(directory):
        (directory / place).parent.mkdir(parents=True, exist_ok=True)
        # Stopped in between, there is no such network rather than one's settings beside another's weights.
        if replaces := settings.pop(section, None) is not None:
            write_json(path, settings)
        save_weights(directory / place, params)
        write_json(path, settings | {section: to_dict(config)})
    return replaces


def load_tokenizer(directory: Path) -> tuple[TokenizerConfig, Params]:
    """Reads the tokenizer of a converted or a run directory.

    Raises:
        UserError: there is none, or it is damaged.
    """
    config = read_tokenizer_config(directory)
    shapes = jax.eval_shape(Tokenizer(config).init_params, jax.random.key(0))
    return config, load_weights(directory / "tokenizer" / "weights", shapes)


def load_world_model(directory: Path) -> tuple[Architecture, Params]:
    """Reads the world model of a converted directory, or of a run of RoboScape or Genie.

    Raises:
        UserError: there is none, or it is damaged.
    """
    architecture = read_architecture(directory)
    shapes = jax.eval_shape(Transformer(architecture).init_params, jax.random.key(0))
    return architecture, load_weights(directory / "world_model" / "weights", shapes)
