"""Maps the names of ``diffusers``' CogVideoX: AutoencoderKLCogVideoX and CogVideoXTransformer3DModel.

The ``config.json`` that is published beside the weights contains what they do not reveal: the scaling factor of the
latents, and how positions are encoded. The weights of a large transformer are in several files; name any one of them.
"""

import math
import re
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict

from rsjax.config import CausalVAEConfig, CogVideoXConfig, ConfigError
from rsjax.models.cogvideox import autoencoder
from rsjax.models.cogvideox.pretrained import saved_architecture
from rsjax.models.cogvideox.transformer import shapes
from rsjax.tools.convert.files import ConvertError, Tensors, setting
from rsjax.tools.convert.table import (
    SAME_NAMES,
    Entry,
    Layout,
    Names,
    Table,
    norm,
    shape_of,
    to_params,
    weight_and_bias,
)
from rsjax.trainable import Params

CONFIG = "config.json"
CLASSES = {"tokenizer": "AutoencoderKLCogVideoX", "world_model": "CogVideoXTransformer3DModel"}
FACTOR = 0.7  # scaling factor of 5B-I2V's latents; 2B's is 1.15258426
WIDTH_2B = 1920
ASIDE = re.compile(r"patch_embed\.pos_embedding")  # stored by networks with fixed positions, which are computed here

# Parts of the autoencoder's paths, and the public names for them.
_PARTS = (
    (r"(down|up)_(\d+)_block_(\d+)", r"\1_blocks.\2.resnets.\3"),
    (r"(down|up)_(\d+)_(down|up)sample", r"\1_blocks.\2.\3samplers.0"),
    (r"mid_block_(\d)", r"mid_block.resnets.\1"),
    (r"\b(conv_in|conv_out|conv\d|conv_y|conv_b)\.(kernel|bias)$", r"\1.conv.\2"),
    (r"\b(kernel|scale)$", "weight"),
)
_LAYOUTS: dict[int, Layout] = {2: "linear3d", 4: "conv", 5: "conv3d"}


def autoencoder_table(of: Params) -> Table:
    """Returns an entry for each parameter of encoder and decoder; ``of`` gives the parameters' shapes."""
    entries = []
    for path, x in flatten_dict(of, sep="/").items():
        key = path.replace("/", ".")
        for own, public in _PARTS:
            key = re.sub(own, public, key)
        entries.append(Entry(key, path, _LAYOUTS[x.ndim] if path.endswith("kernel") else "same"))
    return tuple(entries)


def transformer_table(config: CogVideoXConfig) -> Table:
    """Returns an entry for each public tensor of the transformer."""
    linears = {
        "patch_embed.text_proj": "text_proj",
        "time_embedding.linear_1": "time/fc1",
        "time_embedding.linear_2": "time/fc2",
        "norm_out.linear": "norm_out_linear",
        "proj_out": "proj_out",
    }
    entries: list[Entry] = [*weight_and_bias("patch_embed.proj", "patches", "conv")]
    entries += [entry for key, path in linears.items() for entry in weight_and_bias(key, path, "linear")]
    entries += [*norm("norm_final", "norm_final"), *norm("norm_out.norm", "norm_out")]
    if config.learned_positions:
        entries.append(Entry("patch_embed.pos_embedding", "learned_positions", "lead"))
    names = {f"attn1.to_{name}": f"to_{name}" for name in "qkv"} | {"attn1.to_out.0": "to_out"}
    names |= {"ff.net.0.proj": "fc1", "ff.net.2": "fc2"}
    names |= {f"norm{i}.linear": f"norm{i}_linear" for i in (1, 2)}
    norms = {"attn1.norm_q": "norm_q", "attn1.norm_k": "norm_k", "norm1.norm": "norm1", "norm2.norm": "norm2"}
    for i in range(config.blocks):
        block = f"transformer_blocks.{i}"
        for public, own in names.items():
            entries += weight_and_bias(f"{block}.{public}", f"blocks/{own}", "linear", i)
        for public, own in norms.items():
            entries += norm(f"{block}.{public}", f"blocks/{own}", i)
    return tuple(entries)


def is_autoencoder(source: object, tensors: Tensors) -> bool:
    """Returns whether the tensors are an autoencoder's, not a transformer's.

    Raises:
        ConvertError: they belong to neither, or to CogVideoX 1.5.
    """
    if "decoder.mid_block.resnets.0.norm1.conv_y.conv.weight" in tensors:
        return True
    patches = tensors.get("patch_embed.proj.weight")
    if patches is None or "patch_embed.text_proj.weight" not in tensors:
        raise ConvertError(
            f"{source}: holds no network of CogVideoX, such as patch_embed.text_proj.weight of its transformer or "
            f"decoder.mid_block.resnets.0.norm1.conv_y.conv.weight of its autoencoder"
        )
    if patches.ndim != 4:
        raise ConvertError(
            f"{source}: patch_embed.proj.weight has {patches.ndim} axes, as in CogVideoX 1.5; pass 1.0's"
        )
    return False


def autoencoder_from_public(
    source: object, tensors: Tensors, settings: dict[str, Any], names: Names = SAME_NAMES
) -> tuple[CausalVAEConfig, Params]:
    """Returns an autoencoder's settings and parameters.

    Args:
        settings: the file's settings, from ``published_settings``; without them the latents' factor is 5B-I2V's.
        names: the tensors' names in the file, where they differ, for error messages.

    Raises:
        ConvertError: tensors are missing, unexpected, of the wrong shape or not finite; or the settings do not fit.
    """
    factor = setting(source, settings, "scaling_factor", FACTOR)
    groups = setting(source, settings, "norm_num_groups", 32)
    first = re.compile(r"encoder\.down_blocks\.(\d+)\.resnets\.(\d+)\.conv1\.conv\.weight")
    places = [(int(match[1]), int(match[2])) for match in map(first.fullmatch, tensors) if match]
    levels, blocks = (max(column) + 1 for column in zip(*places, strict=True)) if places else (0, 0)

    def width(key: str) -> int:
        return shape_of(source, tensors, f"{key}.conv.weight", 5, names)[0]

    try:
        config = CausalVAEConfig(
            latent_channels=width("encoder.conv_out") // 2,
            patch_size=max(1, round((width("decoder.conv_out") / 3) ** 0.5)),
            widths=tuple(width(f"encoder.down_blocks.{level}.resnets.0.conv1") for level in range(levels)),
            res_blocks=blocks,
            norm_groups=groups,
        )
    except ConfigError as error:
        raise ConvertError(f"{source}: the network inferred from its tensors cannot be built: {error}") from error
    of = jax.eval_shape(lambda key: autoencoder.init(config, key), jax.random.key(0))
    latents = of.pop("latents")
    fixed = {"mean": 0.0, "log_deviation": -math.log(factor)}
    params = to_params(source, tensors, autoencoder_table(of), of, names)
    return config, params | {"latents": {n: np.full(x.shape, fixed[n], np.float32) for n, x in latents.items()}}


def transformer_from_public(
    source: object, tensors: Tensors, settings: dict[str, Any], names: Names = SAME_NAMES
) -> tuple[CogVideoXConfig, Params, int]:
    """Returns a transformer's settings and parameters, and how many tensors (fixed positions) were left aside.

    Arguments and errors are those of :func:`autoencoder_from_public`. Without settings, the width decides whether the
    network is 2B's or 5B's, and learned positions are taken to be for 480×720 pixels.
    """
    config = infer_transformer(source, tensors, settings, names)
    used = {name: x for name, x in tensors.items() if config.learned_positions or not ASIDE.search(name)}
    of = shapes(saved_architecture(config))
    of.pop("task_tokens", None)
    return config, to_params(source, used, transformer_table(config), of, names), len(tensors) - len(used)


def infer_transformer(
    source: object, tensors: Tensors, settings: dict[str, Any], names: Names = SAME_NAMES
) -> CogVideoXConfig:
    """Infers the network from the names and shapes of its tensors, and from its settings.

    Raises:
        ConvertError: the network cannot be built.
    """

    def shape(key: str, axes: int) -> tuple[int, ...]:
        return shape_of(source, tensors, key, axes, names)

    (width, inputs, patch, _), text = shape("patch_embed.proj.weight", 4), shape("patch_embed.text_proj.weight", 2)[1]
    channels = shape("proj_out.weight", 2)[0] // patch**2
    head = shape("transformer_blocks.0.attn1.norm_q.weight", 1)[0]
    read = partial(setting, source, settings)
    tokens, learned = read("max_text_seq_length", 226), tuple[int, ...]()
    rotary = read("use_rotary_positional_embeddings", width != WIDTH_2B)
    if read("use_learned_positional_embeddings", rotary) and "patch_embed.pos_embedding" in tensors:
        sides = (read("sample_height", 60), read("sample_width", 90))
        frames = (read("sample_frames", 49) - 1) // read("temporal_compression_ratio", 4) + 1
        learned = (frames, *(side // patch for side in sides))
    try:
        config = CogVideoXConfig(
            width=width,
            blocks=sum(bool(re.fullmatch(r"transformer_blocks\.\d+\.attn1\.to_q\.weight", name)) for name in tensors),
            heads=max(1, width // head),
            mlp_ratio=max(1, shape("transformer_blocks.0.ff.net.0.proj.weight", 2)[0] // width),
            patch_size=patch,
            time_width=shape("time_embedding.linear_1.weight", 2)[0],
            image="channels" if inputs == 2 * channels else "first_latent",
            positions="rotary" if rotary else "sincos",
            position_scale=read("spatial_interpolation_scale", 1.875),
            learned_positions=learned,
            autoencoder=CausalVAEConfig(latent_channels=channels),
        )
        # Public networks have no learned tokens; their text embeddings are in a file.
        return replace(config, text=replace(config.text, file="text.safetensors", tokens=tokens, width=text))
    except (ConfigError, TypeError) as error:
        raise ConvertError(f"{source}: the network inferred from its tensors cannot be built: {error}") from error


def autoencoder_settings(config: CausalVAEConfig, params: Params) -> dict[str, Any]:
    """Returns the settings to write beside an exported autoencoder.

    Raises:
        ConvertError: the public format cannot express the network or its latents' statistics.
    """
    mean, deviation = np.asarray(params["latents"]["mean"]), np.exp(params["latents"]["log_deviation"])
    if config.patch_size > 1 or np.any(mean) or np.ptp(deviation) > 0:
        raise ConvertError(
            "the public format has neither model.autoencoder.patch_size above 1 nor means and factors of single latent "
            "channels, as an autoencoder that a run trained has"
        )
    levels = len(config.widths)
    return {
        "_class_name": CLASSES["tokenizer"],
        "block_out_channels": list(config.widths),
        "down_block_types": ["CogVideoXDownBlock3D"] * levels,
        "up_block_types": ["CogVideoXUpBlock3D"] * levels,
        "layers_per_block": config.res_blocks,
        "latent_channels": config.latent_channels,
        "norm_num_groups": config.norm_groups,
        "scaling_factor": round(float(1 / deviation[0]), 7),
    }


def transformer_settings(config: CogVideoXConfig) -> dict[str, Any]:
    """Returns the settings to write beside an exported transformer."""
    channels, learned = config.autoencoder.latent_channels, config.learned_positions
    settings = {
        "_class_name": CLASSES["world_model"],
        "num_attention_heads": config.heads,
        "attention_head_dim": config.width // config.heads,
        "num_layers": config.blocks,
        "in_channels": channels * (1 + (config.image == "channels")),
        "out_channels": channels,
        "patch_size": config.patch_size,
        "time_embed_dim": config.time_width,
        "text_embed_dim": config.text.width,
        "max_text_seq_length": config.text.tokens,
        "spatial_interpolation_scale": config.position_scale,
        "use_rotary_positional_embeddings": config.positions == "rotary",
        "use_learned_positional_embeddings": bool(learned),
    }
    if learned:
        sides = {"sample_height": learned[1] * config.patch_size, "sample_width": learned[2] * config.patch_size}
        settings |= sides | {"sample_frames": 4 * (learned[0] - 1) + 1, "temporal_compression_ratio": 4}
    return settings
