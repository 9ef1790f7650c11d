"""Maps the names of the public iVideoGPT checkpoints: the conditional VQ tokenizer, and the LLaMA with its actions.

The weights' shapes reveal neither the number of attention heads nor that of the norms' groups. The public tokenizers
have 4 heads and 32 groups; the public transformers have heads of 64 channels.
"""

import json
import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from rsjax.config import ConfigError, from_dict, to_dict
from rsjax.files import parse_json, read_json
from rsjax.model_directory import Part, load_part
from rsjax.models.ivideogpt.conditional_vq import ConditionalVQ
from rsjax.models.ivideogpt.config import ConditionalVQConfig, IVideoGPTConfig
from rsjax.models.ivideogpt.llama import Architecture, LLaMA
from rsjax.models.ivideogpt.sequence import Layout
from rsjax.models.network_settings import Inputs, read_model, saved_inputs
from rsjax.tools.convert.directory import save_part, saved_part
from rsjax.tools.convert.files import (
    REPLACES,
    SETTINGS,
    ConvertError,
    Tensors,
    check_file,
    check_type,
    described,
    left_aside,
    write_safetensors,
)
from rsjax.tools.convert.sources import read_network, weights_files
from rsjax.tools.convert.table import (
    SAME_NAMES,
    Entry,
    Names,
    Table,
    shape_of,
    to_params,
    to_tensors,
    vae_table,
    weight_and_bias,
)
from rsjax.trainable import Params

HEADS = "num_attention_heads"  # in the settings of a transformer
METADATA = "rsjax.ivideogpt"  # metadata key under which an exported file keeps settings and inputs
PARTS: tuple[Part, ...] = ("tokenizer", "world_model")
FOLDERS: dict[Part, str] = {"tokenizer": "tokenizer", "world_model": "transformer"}  # of a whole public model
# Tensors of public transformers that this project does not use: heads for rewards and actions, and fixed rotations.
ASIDE = re.compile(r"^(reward_linear|action_recon_linear)|rotary_emb\.inv_freq$")

# Parts of the tokenizer's paths that autoencoders of ``diffusers`` lack, and their public names.
_PARTS = (
    (r"cross_(\d+)", r"cross_att_blocks.\1"),
    (r"in_proj_kernel$", "att.in_proj_weight"),
    (r"in_proj_bias$", "att.in_proj_bias"),
    (r"out_proj", "att.out_proj"),
    (r"\bembedding$", "embedding.weight"),
)


def tokenizer_table(shapes: Params) -> Table:
    """Returns an entry for each parameter of the tokenizer."""
    return vae_table(shapes, _PARTS)


def tokenizer_shapes(config: ConditionalVQConfig, image_size: int) -> Params:
    """Returns the shapes of the tokenizer's parameters."""
    return jax.eval_shape(lambda key: ConditionalVQ(config).init_params(key, image_size), jax.random.key(0))


def infer_tokenizer(source: object, tensors: Tensors, names: Names = SAME_NAMES) -> tuple[ConditionalVQConfig, int]:
    """Infers the tokenizer's settings and the side of its images from the names and shapes of its tensors.

    Raises:
        ConvertError: the tensors are not such a tokenizer's, or belong to one that this project cannot build.
    """

    def shape(key: str, axes: int) -> tuple[int, ...]:
        return shape_of(source, tensors, key, axes, names)

    if not {"dynamics_quantize.embedding.weight", "encoder.conv_in.weight"} <= tensors.keys():
        raise ConvertError(f"{source}: holds no tokenizer of iVideoGPT, such as dynamics_quantize.embedding.weight")
    block = "encoder.down_blocks.{}.resnets.{}.conv1.weight"
    levels = _count(tensors, lambda i: block.format(i, 0))
    crossed = _count(tensors, lambda i: f"cond_encoder.cross_att_blocks.{i}.q_pos_emb")
    positions = [shape(f"cond_encoder.cross_att_blocks.{i}.q_pos_emb", 2)[0] for i in range(crossed)]
    if not levels or not positions:
        raise ConvertError(f"{source}: holds no levels of iVideoGPT's tokenizer, such as {block.format(0, 0)}")
    codes, latent = shape("dynamics_quantize.embedding.weight", 2)
    keys = shape("cond_encoder.cross_att_blocks.0.kv_pos_emb", 2)[0]
    patch = math.isqrt(shape("encoder.conv_in.weight", 4)[1] // 3)
    widths = tuple(shape(block.format(i, 0), 4)[0] for i in range(levels))
    try:
        config = ConditionalVQConfig(
            context_frames=keys // positions[0],
            patch_size=patch,
            widths=widths,
            res_blocks=_count(tensors, lambda j: block.format(0, j)),
            latent=latent,
            codes=codes,
            future_patch=math.isqrt(shape("quant_linear.weight", 2)[1] // latent),
            attention_size=math.isqrt(positions[0]),
        )
    except ConfigError as error:
        raise ConvertError(f"{source}: the network inferred from its tensors cannot be built: {error}") from error
    return config, math.isqrt(positions[-1]) * config.downsampling


def tokenizer_from_public(
    source: object,
    tensors: Tensors,
    own: tuple[ConditionalVQConfig, int] | None = None,
    names: Names = SAME_NAMES,
) -> tuple[ConditionalVQConfig, int, Params]:
    """Returns the tokenizer's settings, the side of its images and its parameters.

    Args:
        own: settings and side, if the file was exported by this project and states them; None infers them.

    Raises:
        ConvertError: tensors are missing, unexpected, of the wrong shape, not finite, or not a tokenizer's.
    """
    config, size = own or infer_tokenizer(source, tensors, names)
    shapes = tokenizer_shapes(config, size)
    return config, size, to_params(source, tensors, tokenizer_table(shapes), shapes, names)


def _count(tensors: Mapping[str, Any], key: Any) -> int:
    number = 0
    while key(number) in tensors:
        number += 1
    return number


def convert(source: Path, out: Path, heads: int | None = None, part: Part | None = None) -> list[str]:
    """Imports a public tokenizer or transformer into a directory, or both from the directory of a whole model.

    Args:
        heads: attention heads of the transformer, see :func:`infer_llama`.
        part: the part to import of a whole model; None: both.

    Raises:
        UserError: the source cannot be read or does not fit, or ``out`` cannot be written.
    """
    return [line for file in weights_files(source, FOLDERS, part) for line in _convert(file, out, heads)]


def _convert(source: Path, out: Path, heads: int | None) -> list[str]:
    tensors, metadata, names, others, _ = read_network(source)
    own = None
    if METADATA in metadata:
        try:
            settings = parse_json(metadata[METADATA])
            own = (from_dict(IVideoGPTConfig, settings["model"]), Inputs(**settings["inputs"]))
        except (ValueError, TypeError, KeyError, ConfigError) as error:
            raise ConvertError(
                f"{source}: its metadata {METADATA} are of another version or damaged ({error})"
            ) from error
    if "dynamics_quantize.embedding.weight" in tensors:
        networks = None
        if own is not None:
            networks = (own[0].autoencoder, own[1].image_size)
        vq, size, params = tokenizer_from_public(source, tensors, networks, names)
        before = saved_part(out, IVideoGPTConfig, "world_model")
        model = replace(before[0] if before else IVideoGPTConfig(), autoencoder=vq)
        _check_codes(out, before and before[0], model)
        inputs = Inputs(size, before[1].action_dim if before else 0)
        replaces = save_part(out, "tokenizer", model, inputs, params)
        return [f"{out}: a tokenizer of {len(tensors)} tensors, {vq}{REPLACES * replaces}", *left_aside(others)]
    aside = Counter(ASIDE.search(name)[0] for name in tensors if ASIDE.search(name))  # type: ignore[index]
    used = {name: x for name, x in tensors.items() if not ASIDE.search(name)}
    if own:
        model = own[0]
        actions = own[1].action_dim
    else:
        path = source.parent / SETTINGS
        if not heads and path.exists():
            cure = f"put the published one beside {source.name}, or delete it"
            heads = read_json(path, cure=cure).get(HEADS)
            check_type(path, HEADS, heads, 1)
            if heads is not None and heads < 1:
                raise ConvertError(f"{path}: {HEADS} is {heads}, not above 0")
        model, actions = infer_llama(source, used, heads or None, names)
    shapes = _llama_shapes(model, actions)
    params = to_params(source, used, llama_table(model), shapes, names)
    before = saved_part(out, IVideoGPTConfig, "tokenizer")
    whole = model
    if before:
        whole = replace(model, autoencoder=before[0].autoencoder)
    _check_codes(out, before and before[0], model)
    sizes = [found.image_size for _, found in filter(None, (before, own))]
    inputs = Inputs(sizes[0] if sizes else 0, actions)
    replaces = save_part(out, "world_model", whole, inputs, params)
    lines = left_aside(aside, others)
    return [f"{out}: a transformer of {len(used)} tensors, {described(model)}{REPLACES * replaces}", *lines]


def export(source: Path, out: Path, part: Part | None = None) -> list[str]:
    """Exports a directory's tokenizer or transformer to a safetensors file. Errors as in :func:`convert`.

    Args:
        part: the part to export; None: the only one.
    """
    replaces = check_file(out)
    parts = [p for p in PARTS if saved_part(source, IVideoGPTConfig, p)]
    if part not in parts and len(parts) != 1:
        raise ConvertError(f"{source}: holds {' and '.join(parts) or 'no part of an iVideoGPT'}; name one with --part")
    if part not in parts:
        part = parts[0]
    model = read_model(source, IVideoGPTConfig, part)
    inputs = saved_inputs(source)
    if part == "tokenizer":
        shapes = tokenizer_shapes(model.autoencoder, inputs.image_size)
        entries = tokenizer_table(shapes)
    else:
        shapes = _llama_shapes(model, inputs.action_dim)
        entries = llama_table(model)
    tensors = to_tensors(load_part(source, part, shapes), entries)
    write_safetensors(out, tensors, {METADATA: json.dumps({"model": to_dict(model), "inputs": inputs._asdict()})})
    return [f"{out}: {len(tensors)} tensors of iVideoGPT's {part}, under their public names{replaces}"]


def _llama_shapes(model: IVideoGPTConfig, actions: int) -> Params:
    """Returns the shapes of the transformer's parameters; ``actions`` is the size of an action, even if unused."""
    inputs = actions * (1 + model.integrate_actions) * model.use_actions
    layout = Layout(model.autoencoder.codes, 1, 1, 1, model.positions)  # the parameters depend only on its vocabulary
    return jax.eval_shape(LLaMA(Architecture(model, layout, inputs)).init_params, jax.random.key(0))


def _check_codes(directory: Path, there: IVideoGPTConfig | None, model: IVideoGPTConfig) -> None:
    codes = model.autoencoder.codes
    if there is not None and there.autoencoder.codes != codes:
        raise ConvertError(
            f"{directory}: holds a part of an iVideoGPT with {there.autoencoder.codes} codes, this one has {codes}; "
            f"choose another directory"
        )


def llama_table(config: IVideoGPTConfig) -> Table:
    """Returns an entry for each parameter of the LLaMA; with actions the public names begin with ``llm``."""
    under = ""
    if config.use_actions:
        under = "llm."
    entries: list[Entry] = [
        Entry(f"{under}model.embed_tokens.weight", "embed_tokens/embedding"),
        Entry(f"{under}model.norm.weight", "norm/scale"),
        Entry(f"{under}lm_head.weight", "lm_head/kernel", "linear"),
    ]
    for i in range(config.blocks):
        layer = f"{under}model.layers.{i}"
        for name in ("input_layernorm", "post_attention_layernorm"):
            entries.append(Entry(f"{layer}.{name}.weight", f"blocks/{name}/scale", layer=i))
        for part, names in (("self_attn", "qkvo"), ("mlp", ("gate", "up", "down"))):
            for name in names:
                key = f"{layer}.{part}.{name}_proj.weight"
                path = f"blocks/{name}_proj/kernel"
                entries.append(Entry(key, path, "linear", i))
    if config.use_actions:
        entries += weight_and_bias("action_linear", "action_linear", "linear")
    return tuple(entries)


def infer_llama(
    source: object, tensors: Tensors, heads: int | None = None, names: Names = SAME_NAMES
) -> tuple[IVideoGPTConfig, int]:
    """Infers the LLaMA's settings and the size of an action (0 without actions) from the shapes of its tensors.

    Args:
        heads: attention heads; None: heads of 64 channels each, as in the public models.
        names: the tensors' names in the file, where they differ, for error messages.

    Raises:
        ConvertError: the tensors are not such a LLaMA's, or belong to one that this project cannot build.
    """
    use_actions = "action_linear.weight" in tensors
    under = ""
    if use_actions:
        under = "llm."
    layer = f"{under}model.layers.{{}}.self_attn.q_proj.weight"
    embedding = f"{under}model.embed_tokens.weight"
    if not {layer.format(0), embedding} <= tensors.keys():
        raise ConvertError(f"{source}: holds no LLaMA of iVideoGPT, such as {layer.format(0)}")
    vocabulary, width = shape_of(source, tensors, embedding, 2, names)
    hidden = shape_of(source, tensors, f"{under}model.layers.0.mlp.gate_proj.weight", 2, names)[0]
    actions = 0
    if use_actions:
        actions = shape_of(source, tensors, "action_linear.weight", 2, names)[1]
    try:
        config = IVideoGPTConfig(
            autoencoder=ConditionalVQConfig(codes=max(1, vocabulary // 2 - 1)),
            width=width,
            blocks=_count(tensors, layer.format),
            heads=heads or max(1, width // 64),
            mlp_width=hidden,
            use_actions=use_actions,
        )
    except ConfigError as error:
        raise ConvertError(f"{source}: the network inferred from its tensors cannot be built: {error}") from error
    return config, actions
