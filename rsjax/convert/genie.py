"""The public names of 1xgpt's STMaskGIT, the "Genie" baseline: the RGB branch of a model without actions.

Weights do not tell everything: heads and muP stand in the ``config.json`` beside them (GenieConfig).
"""

import json
import math
from pathlib import Path
from typing import Any

import jax

from rsjax.config import ModelConfig
from rsjax.convert.files import ConvertError, Tensors
from rsjax.convert.table import Entry, Table, norm, to_params, weight_and_bias
from rsjax.models.roboscape.world_model import WorldModel

CONFIG = "config.json"

# Settings under which the public network has other parameters than this project's.
FIXED = {"qkv_bias": False, "proj_bias": True, "mlp_bias": True}


def table(config: ModelConfig) -> Table:
    """Every public tensor of the network.

    Raises:
        ConvertError: positions are not learned, which no public tensor tells.
    """
    if config.positions != "learned":
        raise ConvertError(
            f"the public format has no name for these parts of the network: model.positions {config.positions!r}; "
            f"only learned positions can go out"
        )
    entries: list[Entry] = [
        Entry("pos_embed_TSC", "pos_embed", "lead"),
        Entry("token_embed.mask_token_embed", "rgb_embed/mask_token_embed", "lead"),
    ]
    for k in range(config.vocabularies):
        entries.append(
            Entry(f"token_embed.factored_embeds.{k}.weight", f"rgb_embed/factored_embed_{k}/embedding"),
        )
    for i in range(config.blocks):
        layer, path = f"decoder.layers.{i}", "blocks/rgb"
        if not config.qk_norm:
            entries += norm(f"{layer}.norm1", f"{path}/norm1", i) + norm(f"{layer}.norm2", f"{path}/norm2", i)
        for name in ("spatial_attn", "temporal_attn"):
            # Rows (3, heads, head width) on both sides, so that the transpose is all.
            entries.append(Entry(f"{layer}.{name}.qkv.weight", f"{path}/{name}/qkv/kernel", "linear", i))
            entries += weight_and_bias(f"{layer}.{name}.proj", f"{path}/{name}/proj", "linear", i)
            if config.qk_norm:
                entries += norm(f"{layer}.{name}.norm", f"{path}/{name}/norm", i)
        for name in ("fc1", "fc2"):
            entries += weight_and_bias(f"{layer}.mlp.{name}", f"{path}/{name}", "linear", i)
    entries += weight_and_bias("out_x_proj", "rgb_head", "linear")
    return tuple(entries)


def read_settings(path: Path) -> dict[str, Any]:
    """The GenieConfig beside a file of weights; empty where there is none.

    Raises:
        ConvertError: it is damaged, or settings of something else.
    """
    beside = path.parent / CONFIG
    if not beside.exists():
        return {}
    try:
        settings = json.loads(beside.read_text())
    except ValueError as error:
        raise ConvertError(f"{beside}: not JSON ({error})") from error
    if not isinstance(settings, dict):
        raise ConvertError(f"{beside}: not a GenieConfig; it holds no settings by name")
    if not settings.keys() & {"num_layers", "num_heads"}:
        raise ConvertError(
            f"{beside}: not a GenieConfig; it has neither num_layers nor num_heads; put the published one beside "
            f"{path.name}, or nothing of that name"
        )
    return settings


def infer_config(source: Path, tensors: Tensors, settings: dict[str, Any], heads: int | None = None) -> ModelConfig:
    """The network that these tensors are of, from names, shapes and settings.

    Args:
        settings: a GenieConfig's fields; those on training are not read.
        heads: overrides the settings' num_heads.

    Raises:
        ConvertError: they are no Genie's, contradict the settings, or leave the number of heads open; or the settings
            are of a network that this project does not have.
    """
    position, first = tensors.get("pos_embed_TSC"), tensors.get("token_embed.factored_embeds.0.weight")
    hidden = tensors.get("decoder.layers.0.mlp.fc1.weight")
    if position is None or position.ndim != 4 or first is None or hidden is None:
        raise ConvertError(f"{source}: holds no weights of a Genie (STMaskGIT), such as pos_embed_TSC")
    _, frames, cells, width = position.shape
    counts = [
        sum(name.startswith(start) and name.endswith(end) for name in tensors)
        for start, end in (("decoder.layers.", ".mlp.fc1.weight"), ("token_embed.factored_embeds.", ".weight"))
    ]
    blocks, vocabularies = counts
    shared = tensors.get("decoder.layers.0.spatial_attn.norm.weight")
    found = {
        "num_layers": blocks,
        "d_model": width,
        "T": frames,
        "S": cells,
        "image_vocab_size": len(first) ** vocabularies,
        "num_factored_vocabs": vocabularies,
        "factored_vocab_size": len(first),
        "qk_norm": shared is not None,
        "mlp_ratio": len(hidden) / width,
    }
    _check_settings(source, settings, found)
    if heads is None:
        heads = settings.get("num_heads", None if shared is None else width // len(shared))
    if not isinstance(heads, int) or heads < 1:
        raise ConvertError(
            f"{source}: the number of attention heads is {heads or 'unknown'} and the weights do not tell; put the "
            f"published {CONFIG} beside the file, or give --heads (8 in the public models)"
        )
    return ModelConfig(
        frames=frames,
        grid=math.isqrt(cells),
        code_bits=vocabularies * round(math.log2(len(first))),
        vocabularies=vocabularies,
        action_dim=0,
        width=width,
        blocks=blocks,
        heads=heads,
        mlp_ratio=len(hidden) // width,
        depth=False,
        qk_norm=shared is not None,
        mup=bool(settings.get("use_mup", False)),
    )


def _check_settings(source: Path, settings: dict[str, Any], found: dict[str, Any]) -> None:
    config = source.parent / CONFIG
    for name, only in FIXED.items():
        if settings.get(name) not in (None, only):
            given, known = (json.dumps(value) for value in (settings[name], only))
            raise ConvertError(f"{config}: {name} {given} is not supported, only {known}")
    # Older configurations leave factored_vocab_size out or null: it follows from the others.
    told = {name: settings[name] for name in found if settings.get(name) is not None}
    wrong = [f"{name} is {told[name]}, not {found[name]}" for name in told if told[name] != found[name]]
    if wrong:
        raise ConvertError(f"{config}: does not fit the weights beside it: {'; '.join(wrong)}")


def settings_of(config: ModelConfig) -> dict[str, Any]:
    """The GenieConfig of a model; the inverse of :func:`infer_config`."""
    return {
        "num_layers": config.blocks,
        "num_heads": config.heads,
        "d_model": config.width,
        "T": config.frames,
        "S": config.grid**2,
        "image_vocab_size": 2**config.code_bits,
        "use_mup": config.mup,
        "num_factored_vocabs": config.vocabularies,
        "factored_vocab_size": config.vocabulary_size,
        **FIXED,
        "attn_drop": 0.0,
        "qk_norm": config.qk_norm,
        "mlp_ratio": float(config.mlp_ratio),
        "mlp_drop": 0.0,
    }


def from_public(
    source: Path, tensors: Tensors, settings: dict[str, Any], heads: int | None = None
) -> tuple[ModelConfig, Any]:
    """A model and its parameters from a public file's tensors. Arguments and errors as in :func:`infer_config`.

    Raises:
        ConvertError: also where tensors are missing, left over or misshapen.
    """
    config = infer_config(source, tensors, settings, heads)
    shapes = jax.eval_shape(WorldModel(config).init_params, jax.random.key(0))
    return config, to_params(source, tensors, table(config), shapes)
