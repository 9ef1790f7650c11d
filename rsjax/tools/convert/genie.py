"""Maps the names of 1xgpt's STMaskGIT (the Genie baseline) to the RGB branch of a model without actions.

The weights' shapes do not reveal the number of heads or muP; the ``config.json`` beside them (a GenieConfig) does.
"""

import json
import math
from pathlib import Path
from typing import Any

import jax

from rsjax.config import ConfigError, PublicCodeConfig
from rsjax.files import read_json
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.transformer import Transformer
from rsjax.tools.convert.directory import load_world_model, save
from rsjax.tools.convert.files import (
    REPLACES,
    SETTINGS,
    ConvertError,
    Tensors,
    check_file,
    check_type,
    left_aside,
    write_published,
)
from rsjax.tools.convert.sources import read_network, weights_file
from rsjax.tools.convert.table import SAME_NAMES, Entry, Names, norm, shape_of, to_params, to_tensors, weight_and_bias
from rsjax.trainable import Params

# The only values under which the public network has the same parameters as this project's.
FIXED = {"qkv_bias": False, "proj_bias": True, "mlp_bias": True}


def name_table(config: Architecture) -> tuple[Entry, ...]:
    """Returns an entry for each public tensor of the network.

    Raises:
        ConvertError: the network has rotary positions, which the public format cannot express.
    """
    if config.departures.rotary:
        raise ConvertError(
            "the public format cannot express model.departures.rotary; only a model with learned "
            "positions can be exported"
        )
    entries: list[Entry] = [
        Entry("pos_embed_TSC", "pos_embed", "lead"),
        Entry("token_embed.mask_token_embed", "rgb_embed/mask_token_embed", "lead"),
    ]
    for k in range(config.vocabularies):
        entries.append(Entry(f"token_embed.factored_embeds.{k}.weight", f"rgb_embed/factored_embed_{k}/embedding"))
    for i in range(config.blocks):
        layer = f"decoder.layers.{i}"
        path = "blocks/rgb"
        if not config.public.qk_norm:
            entries += norm(f"{layer}.norm1", f"{path}/norm1", i) + norm(f"{layer}.norm2", f"{path}/norm2", i)
        for name in ("spatial_attn", "temporal_attn"):
            # Both sides order the rows (3, heads, head width), so a transpose is enough.
            entries.append(Entry(f"{layer}.{name}.qkv.weight", f"{path}/{name}/qkv/kernel", "linear", i))
            entries += weight_and_bias(f"{layer}.{name}.proj", f"{path}/{name}/proj", "linear", i)
            if config.public.qk_norm:
                entries += norm(f"{layer}.{name}.norm", f"{path}/{name}/norm", i)
        for name in ("fc1", "fc2"):
            entries += weight_and_bias(f"{layer}.mlp.{name}", f"{path}/{name}", "linear", i)
    entries += weight_and_bias("out_x_proj", "rgb_head", "linear")
    return tuple(entries)


def read_settings(weights: Path) -> dict[str, Any]:
    """Reads the GenieConfig beside a file of weights; returns an empty dict if there is none.

    Raises:
        UserError: the file is damaged or is not a GenieConfig.
    """
    path = weights.parent / SETTINGS
    if not path.exists():
        return {}
    cure = f"put the published one beside {weights.name}, or delete it"
    settings = read_json(path, cure=cure)
    if not settings.keys() & {"num_layers", "num_heads"}:
        raise ConvertError(f"{path}: not a GenieConfig; it has neither num_layers nor num_heads; {cure}")
    return settings


def infer_config(
    source: Path, tensors: Tensors, settings: dict[str, Any], heads: int | None = None, names: Names = SAME_NAMES
) -> Architecture:
    """Infers the network from the names and shapes of its tensors and from its settings.

    Args:
        settings: a GenieConfig's fields; those about training are ignored.
        heads: overrides num_heads of the settings.
        names: the tensors' names in the file, where they differ, for error messages.

    Raises:
        ConvertError: the tensors are not a Genie's, contradict the settings, or leave the number of heads unknown; or
            the settings are of wrong types, or describe a network that this project does not have.
    """

    def shape(key: str, axes: int) -> tuple[int, ...]:
        return shape_of(source, tensors, key, axes, names)

    for name, example in settings_of(Architecture()).items():
        check_type(source.parent / SETTINGS, name, settings.get(name), example)
    position = "pos_embed_TSC"
    first = "token_embed.factored_embeds.0.weight"
    hidden = "decoder.layers.0.mlp.fc1.weight"
    if not {position, first, hidden} <= tensors.keys():
        raise ConvertError(f"{source}: holds no weights of a Genie (STMaskGIT), such as pos_embed_TSC")
    _, frames, cells, width = shape(position, 4)
    blocks, vocabularies = (
        sum(name.startswith(start) and name.endswith(end) for name in tensors)
        for start, end in (("decoder.layers.", ".mlp.fc1.weight"), ("token_embed.factored_embeds.", ".weight"))
    )
    shared = "decoder.layers.0.spatial_attn.norm.weight"  # of qk-norm: one value per channel of a head
    if heads is None:
        heads = settings.get("num_heads")
    if heads is None and shared in tensors:
        heads = width // shape(shared, 1)[0]
    if heads is None or heads < 1:
        raise ConvertError(
            f"{source}: the number of attention heads is {'unknown' if heads is None else heads}; "
            f"put the published {SETTINGS} beside the file, or set --heads (8 in the public models)"
        )
    try:
        public = PublicCodeConfig(
            qk_norm=shared in tensors,
            mup=settings.get("use_mup") or False,
            mlp_ratio=max(1, shape(hidden, 2)[0] // width),
        )
        config = Architecture(
            frames=frames,
            grid=math.isqrt(cells),
            code_bits=vocabularies * round(math.log2(shape(first, 2)[0])),
            vocabularies=vocabularies,
            action_encoder="none",
            action_inputs=0,
            width=width,
            blocks=blocks,
            heads=heads,
            depth="none",
            public_code=None if public == PublicCodeConfig() else public,
        )
    except ConfigError as error:
        raise ConvertError(f"{source}: the network inferred from its tensors cannot be built: {error}") from error
    _check_settings(source.parent / SETTINGS, settings, settings_of(config) | {"S": cells})
    return config


def _check_settings(path: Path, settings: dict[str, Any], inferred: dict[str, Any]) -> None:
    # Older configurations omit factored_vocab_size or set it to null: it follows from the other fields.
    written = {name: value for name, value in settings.items() if value is not None}
    for name, only in FIXED.items():
        if written.get(name, only) != only:
            value = json.dumps(written[name])
            known = json.dumps(only)
            raise ConvertError(f"{path}: {name} {value} is not supported, only {known}")
    names = inferred.keys() & written.keys() - {"num_heads", "use_mup", "attn_drop", "mlp_drop"}
    wrong = [f"{n} is {written[n]}, not {x}" for n, x in inferred.items() if n in names and written[n] != x]
    if wrong:
        raise ConvertError(f"{path}: does not fit the weights beside it: {'; '.join(wrong)}")


def settings_of(config: Architecture) -> dict[str, Any]:
    """Returns the GenieConfig of a model; the inverse of :func:`infer_config`."""
    return {
        "num_layers": config.blocks,
        "num_heads": config.heads,
        "d_model": config.width,
        "T": config.frames,
        "S": config.grid**2,
        "image_vocab_size": 2**config.code_bits,
        "use_mup": config.public.mup,
        "num_factored_vocabs": config.vocabularies,
        "factored_vocab_size": config.vocabulary_size,
        **FIXED,
        "attn_drop": 0.0,
        "qk_norm": config.public.qk_norm,
        "mlp_ratio": float(config.public.mlp_ratio),
        "mlp_drop": 0.0,
    }


def from_public(
    source: Path, tensors: Tensors, settings: dict[str, Any], heads: int | None = None, names: Names = SAME_NAMES
) -> tuple[Architecture, Params]:
    """Returns a model's configuration and parameters, converted from a public file's tensors.

    Arguments and errors as in :func:`infer_config`; also raises ConvertError if tensors are missing, unexpected, of
    another shape or no finite floats.
    """
    config = infer_config(source, tensors, settings, heads, names)
    shapes = jax.eval_shape(Transformer(config).init_params, jax.random.key(0))
    return config, to_params(source, tensors, name_table(config), shapes, names)


def convert(source: Path, out: Path, heads: int | None) -> list[str]:
    """Imports a public Genie into a directory.

    Raises:
        UserError: the source cannot be read or does not fit, or ``out`` cannot be written.
    """
    source = weights_file(source)
    tensors, _, names, others, _ = read_network(source)
    settings = read_settings(source)
    config, params = from_public(source, tensors, settings, heads, names)
    replaces = REPLACES * save(out, config, params)
    lines = [f"{out}: a world model of {len(tensors)} tensors, {config}{replaces}", *left_aside(others)]
    if settings.get("use_mup") is None:
        lines.append(f"no use_mup in a {SETTINGS} beside {source.name}: converted as a model without muP")
    return lines


def export(source: Path, out: Path) -> list[str]:
    """Exports a directory's world model to a safetensors file. Errors as in :func:`convert`."""
    replaces = check_file(out)
    config, params = load_world_model(source)
    tensors = to_tensors(params, name_table(config))
    write_published(out, tensors, settings_of(config))
    text = f"under their public names; settings in {SETTINGS}{replaces}"
    return [f"{out}: {len(tensors)} tensors of a Genie, {text}"]
