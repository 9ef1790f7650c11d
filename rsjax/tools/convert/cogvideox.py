"""Maps the names of ``diffusers``' CogVideoX: AutoencoderKLCogVideoX and CogVideoXTransformer3DModel.

The ``config.json`` that is published beside the weights contains what they do not reveal: the scaling factor of the
latents, and how positions are encoded. The pipeline's ``scheduler_config.json`` contains the forward process.
"""

import importlib
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.clip import UNKNOWN
from rsjax.config import ConfigError
from rsjax.data.store import open_store
from rsjax.errors import first_line
from rsjax.files import read_json, write_file, write_json
from rsjax.model_directory import Part, load_part
from rsjax.models.cogvideox import autoencoder
from rsjax.models.cogvideox.config import CausalVAEConfig, CogVideoXConfig
from rsjax.models.cogvideox.pretrained import saved_architecture
from rsjax.models.cogvideox.text import EMPTY, write_texts
from rsjax.models.cogvideox.transformer import shapes
from rsjax.models.diffusion.config import NoiseConfig
from rsjax.models.network_settings import Inputs, read_model
from rsjax.tools.convert.directory import save_part, saved_part
from rsjax.tools.convert.files import (
    REPLACES,
    SETTINGS,
    ConvertError,
    Tensors,
    check_file,
    described,
    left_aside,
    published_settings,
    setting,
    write_published,
)
from rsjax.tools.convert.sources import read_network, weights_files
from rsjax.tools.convert.table import (
    SAME_NAMES,
    Entry,
    Names,
    Table,
    norm,
    renamed_table,
    shape_of,
    to_params,
    to_tensors,
    weight_and_bias,
)
from rsjax.trainable import Params

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
PARTS: tuple[Part, Part] = ("tokenizer", "world_model")
FOLDERS: dict[Part, str] = {"tokenizer": "vae", "world_model": "transformer"}  # of a whole public pipeline
SCHEDULER = "scheduler_config.json"
TOKENS = 226


def autoencoder_table(of: Params) -> Table:
    """Returns an entry for each parameter of encoder and decoder; ``of`` gives the parameters' shapes."""
    return renamed_table(of, _PARTS, {2: "linear3d", 4: "conv", 5: "conv3d"})


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
    if places:
        levels, blocks = (max(column) + 1 for column in zip(*places, strict=True))
    else:
        levels = 0
        blocks = 0

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

    (width, inputs, patch, _) = shape("patch_embed.proj.weight", 4)
    text = shape("patch_embed.text_proj.weight", 2)[1]
    channels = shape("proj_out.weight", 2)[0] // patch**2
    head = shape("transformer_blocks.0.attn1.norm_q.weight", 1)[0]
    read = partial(setting, source, settings)
    tokens = read("max_text_seq_length", 226)
    learned = tuple[int, ...]()
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
    mean = np.asarray(params["latents"]["mean"])
    deviation = np.exp(params["latents"]["log_deviation"])
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
    channels = config.autoencoder.latent_channels
    learned = config.learned_positions
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


def convert(source: Path, out: Path, part: Part | None = None) -> list[str]:
    """Imports a public autoencoder or transformer into a directory, or both from the directory of a pipeline.

    Args:
        source: the file or directory; if a network has several files (``…-00001-of-00003.safetensors``), any of them.
        part: the part to import of a pipeline; None: both.

    Raises:
        UserError: the source cannot be read or does not fit, or ``out`` cannot be written.
    """
    return [line for file in weights_files(source, FOLDERS, part) for line in _convert(file, out)]


def _convert(source: Path, out: Path) -> list[str]:
    tensors, _, names, others, _ = read_network(source)
    settings = published_settings(source, *CLASSES.values())
    vae = is_autoencoder(source, tensors)
    part: Part
    other: Part
    if vae:
        part, other = PARTS
    else:
        part, other = PARTS[::-1]
    if settings.get("_class_name", CLASSES[part]) != CLASSES[part]:
        raise ConvertError(f"{source}: is no {settings['_class_name']}, as {SETTINGS} beside it says")
    saved = saved_part(out, CogVideoXConfig, other)
    before, inputs = saved or (None, Inputs(0, 0))
    if vae:
        network, params = autoencoder_from_public(source, tensors, settings, names)
        model = replace(before or CogVideoXConfig(), autoencoder=network)
        lines = [f"{out}: an autoencoder of {len(tensors)} tensors, {network}", *left_aside(others)]
        if "scaling_factor" not in settings:
            lines.append(f"no {SETTINGS} with scaling_factor beside {source.name}: 5B-I2V's 0.7 is taken")
    else:
        model, params, aside = transformer_from_public(source, tensors, settings, names)
        network = model.autoencoder
        noise = forward_process(source)
        model = replace(model, noise=noise or model.noise, autoencoder=before.autoencoder if before else network)
        lines = [f"{out}: a transformer of {len(tensors) - aside} tensors, {described(model)}"]
        lines += left_aside({"fixed positions, which the network computes": aside}, others)
        if noise is None:
            shift = model.noise.snr_shift
            lines.append(f"no {SCHEDULER} of a pipeline: snr_shift_scale {shift:g} is taken, as of 5B; 2B's is 3")
        else:
            lines.append(f"the pipeline's forward process: {described(noise)}")
    if before and before.autoencoder.latent_channels != network.latent_channels:
        there = before.autoencoder.latent_channels
        here = network.latent_channels
        raise ConvertError(f"{out}: holds a part with {there} latent channels, this one has {here}; choose another OUT")
    lines[0] += REPLACES * save_part(out, part, model, inputs, params)
    return lines


def forward_process(weights: Path) -> NoiseConfig | None:
    """Returns the forward process that a pipeline's scheduler describes; None if there is no such file.

    Args:
        weights: a file of the transformer; the scheduler's settings are beside it, or in the folder ``scheduler``
            beside its folder.

    Raises:
        UserError: the file is damaged, or describes a process that this project does not have.
    """
    places = [weights.parent / SCHEDULER, weights.parent.parent / "scheduler" / SCHEDULER]
    path = next((path for path in places if path.exists()), None)
    if path is None:
        return None
    settings = read_json(path, cure="put the published one there, or delete it")
    known = {"v_prediction": "velocity", "epsilon": "noise"}
    predicted = settings.get("prediction_type", "v_prediction")
    betas = settings.get("beta_schedule", "scaled_linear")
    if predicted not in known or betas not in ("linear", "scaled_linear"):
        raise ConvertError(
            f"{path}: prediction_type {predicted!r:.80} with beta_schedule {betas!r:.80} is not supported, only "
            f"{' or '.join(known)} with linear or scaled_linear"
        )
    read = partial(setting, path, settings)
    try:
        return NoiseConfig(
            steps=read("num_train_timesteps", 1000),
            beta_start=read("beta_start", 0.00085),
            beta_end=read("beta_end", 0.012),
            betas=betas,
            prediction=known[predicted],  # type: ignore[arg-type]
            snr_shift=float(read("snr_shift_scale", 1.0)),
            zero_terminal=read("rescale_betas_zero_snr", True),
        )
    except ConfigError as error:
        raise ConvertError(f"{path}: describes no forward process of this project ({error}); restore it") from error


def scheduler_settings(noise: NoiseConfig) -> dict[str, Any]:
    """Returns the settings of the public scheduler; the inverse of :func:`forward_process`."""
    predicted = {"velocity": "v_prediction", "noise": "epsilon"}
    return {
        "_class_name": "CogVideoXDDIMScheduler",
        "num_train_timesteps": noise.steps,
        "beta_start": noise.beta_start,
        "beta_end": noise.beta_end,
        "beta_schedule": noise.betas,
        "prediction_type": predicted[noise.prediction],
        "snr_shift_scale": noise.snr_shift,
        "rescale_betas_zero_snr": noise.zero_terminal,
        # Not settings here, but diffusers begins elsewhere without them.
        "timestep_spacing": "trailing",
        "clip_sample": False,
        "set_alpha_to_one": True,
    }


def export(source: Path, out: Path, part: Part | None = None) -> list[str]:
    """Exports a directory's autoencoder or transformer to a safetensors file. Errors as in :func:`convert`.

    Args:
        part: the part to export; None: the only one.
    """
    replaces = check_file(out)
    parts = [p for p in PARTS if saved_part(source, CogVideoXConfig, p)]
    if part not in parts and len(parts) != 1:
        raise ConvertError(f"{source}: holds {' and '.join(parts) or 'no part of a CogVideoX'}; name one with --part")
    if part not in parts:
        part = parts[0]
    model = read_model(source, CogVideoXConfig, part)
    if part == "tokenizer":
        of = jax.eval_shape(lambda key: autoencoder.init(model.autoencoder, key), jax.random.key(0))
        params = load_part(source, part, of)
        settings = autoencoder_settings(model.autoencoder, params)
        params = {name: params[name] for name in ("encoder", "decoder")}
        entries = autoencoder_table(params)
    else:
        params = load_part(source, part, shapes(saved_architecture(model)))
        settings = transformer_settings(model)
        entries = transformer_table(model)
    tensors = to_tensors(params, entries)
    write_published(out, tensors, settings)
    if part == "world_model":
        write_json(out.parent / SCHEDULER, scheduler_settings(model.noise))
    text = f"under their public names; settings in {SETTINGS}{replaces}"
    return [f"{out}: {len(tensors)} tensors of CogVideoX's {part}, {text}"]


def embed_texts(source: Path, out: Path, tasks: Sequence[str], store: Path | None, tokens: int = TOKENS) -> list[str]:
    """Embeds the empty text and tasks with a T5 encoder from a local directory.

    Padding is not masked, as in the public code.

    Args:
        source: a directory with ``text_encoder`` (safetensors) and ``tokenizer``, as the public models have.
        tasks: in words.
        store: a store of clips whose tasks are embedded too.
        tokens: length to which each text is padded or cut.

    Raises:
        UserError: the directory holds no such encoder, ``transformers`` is not installed, or there are no tasks.
    """
    replaces = check_file(out)
    stored: list[str] = []
    if store:
        opened = open_store(store)
        splits = [split for split in opened.splits if opened.labelled(split)]
        stored = [task for split in splits for task in opened.labels(split).words.get("task", ())]
        if not splits:
            sources = [opened.source(split) for split in opened.splits]
            stored = [clips[number]["task"] for clips in sources for number in range(len(clips))]
    names = [EMPTY, *dict.fromkeys([*tasks, *(task for task in stored if task != UNKNOWN)])]
    if len(names) == 1:
        raise ConvertError(f"{out}: there are no tasks to embed; name them with --task, or a store with --store")
    try:
        torch, transformers = (importlib.import_module(name) for name in ("torch", "transformers"))
    except ImportError as error:
        raise ConvertError(
            f"{source}: embedding texts needs transformers and PyTorch ({error}); pip install 'rsjax[text]'"
        ) from None
    for folder in ("text_encoder", "tokenizer"):
        if not (source / folder).is_dir():
            raise ConvertError(f"{source}: has no directory {folder}; pass that of a public CogVideoX")
    local: dict[str, Any] = {"local_files_only": True}
    try:
        tokenizer = transformers.AutoTokenizer.from_pretrained(source / "tokenizer", **local)
        encoder = transformers.T5EncoderModel.from_pretrained(source / "text_encoder", use_safetensors=True, **local)
    except Exception as error:  # transformers raises many types for missing and damaged files
        raise ConvertError(f"{source}: holds no T5 encoder with its tokenizer ({first_line(error)})") from error
    made = []
    fixed = {"padding": "max_length", "max_length": tokens, "truncation": True, "return_tensors": "pt"}
    with torch.no_grad():
        for name in names:
            made.append(encoder.eval()(tokenizer(name, **fixed).input_ids)[0].float().numpy())
    embeddings = np.concatenate(made)
    write_file(out, write_texts(names, embeddings))
    return [
        f"{out}: {len(names)} texts of {tokens} tokens of {embeddings.shape[2]} numbers, the empty one first{replaces}"
    ]
