"""Converts CogVideoX and embeds texts, for ``python -m experiments.convert``. Each command returns lines to print."""

import importlib
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.clip import UNKNOWN
from rsjax.config import CogVideoXConfig
from rsjax.data.store import open_store
from rsjax.errors import first_line
from rsjax.files import read_json, write_file, write_json
from rsjax.models.cogvideox import autoencoder
from rsjax.models.cogvideox.pretrained import saved_architecture
from rsjax.models.cogvideox.text import EMPTY, write_texts
from rsjax.models.cogvideox.transformer import shapes
from rsjax.models.saved import Inputs, read_model
from rsjax.tools.convert import cogvideox
from rsjax.tools.convert.commands import REPLACES, check_file
from rsjax.tools.convert.directory import Part, save_part, saved_part
from rsjax.tools.convert.files import (
    SAFE,
    ConvertError,
    TensorFile,
    left_aside,
    published_settings,
    read_tensors,
    write_safetensors,
)
from rsjax.tools.convert.table import to_tensors
from rsjax.training.checkpoint import load_weights

PARTS: tuple[Part, Part] = ("tokenizer", "world_model")
_SHARD = re.compile(r"(.*)-(\d{5})-of-(\d{5})\.safetensors")
TOKENS = 226


def convert(source: Path, out: Path, part: Part | None = None) -> list[str]:
    """Imports a public autoencoder or transformer into a directory, or exports a directory's to a safetensors file.

    Args:
        source: the file or directory; if a network has several files (``…-00001-of-00003.safetensors``), any of them.
        part: the part to export; None: the only one.

    Raises:
        UserError: the source cannot be read or does not fit, or ``out`` cannot be written.
    """
    if source.is_dir():
        return [_export(source, out, part)]
    tensors, _, names, others, _ = _read(source)
    settings, vae = published_settings(source, *cogvideox.CLASSES.values()), cogvideox.is_autoencoder(source, tensors)
    part, other = PARTS if vae else PARTS[::-1]
    if settings.get("_class_name", cogvideox.CLASSES[part]) != cogvideox.CLASSES[part]:
        raise ConvertError(f"{source}: is no {settings['_class_name']}, as {cogvideox.CONFIG} beside it says")
    saved = saved_part(out, CogVideoXConfig, other)
    before, inputs = saved or (None, Inputs(0, 0))
    if vae:
        network, params = cogvideox.autoencoder_from_public(source, tensors, settings, names)
        model = replace(before or CogVideoXConfig(), autoencoder=network)
        lines = [f"{out}: an autoencoder of {len(tensors)} tensors, {network}", *left_aside(others)]
        if "scaling_factor" not in settings:
            lines.append(f"no {cogvideox.CONFIG} with scaling_factor beside {source.name}: 5B-I2V's 0.7 is taken")
    else:
        model, params, aside = cogvideox.transformer_from_public(source, tensors, settings, names)
        network = model.autoencoder
        model = replace(model, autoencoder=before.autoencoder if before else network)
        lines = [f"{out}: a transformer of {len(tensors) - aside} tensors, {model}"]
        lines += left_aside({"fixed positions, which the network computes": aside}, others)
    if before and before.autoencoder.latent_channels != network.latent_channels:
        there, here = before.autoencoder.latent_channels, network.latent_channels
        raise ConvertError(f"{out}: holds a part with {there} latent channels, this one has {here}; choose another OUT")
    lines[0] += REPLACES * save_part(out, part, model, inputs, params)
    return lines


def _read(source: Path) -> TensorFile:
    """Returns the content of a file, or of all files of a network if the file is one of several."""
    if not (match := _SHARD.fullmatch(source.name)):
        return read_tensors(source)
    numbers = range(1, int(match[3]) + 1)
    files = [read_tensors(source.with_name(f"{match[1]}-{i:05d}-of-{match[3]}{SAFE}")) for i in numbers]
    tensors = {name: x for file in files for name, x in file.tensors.items()}
    names = {name: known for file in files for name, known in file.names.items()}
    return TensorFile(tensors, {}, names, {}, "")


def _export(source: Path, out: Path, part: Part | None) -> str:
    replaces, parts = check_file(out), [p for p in PARTS if saved_part(source, CogVideoXConfig, p)]
    if part not in parts and len(parts) != 1:
        raise ConvertError(f"{source}: holds {' and '.join(parts) or 'no part of a CogVideoX'}; name one with --part")
    part = part if part in parts else parts[0]
    model = read_model(source, CogVideoXConfig, part)
    if part == "tokenizer":
        of = jax.eval_shape(lambda key: autoencoder.init(model.autoencoder, key), jax.random.key(0))
        params = load_weights(source / part / "weights", of)
        settings = cogvideox.autoencoder_settings(model.autoencoder, params)
        params = {name: params[name] for name in ("encoder", "decoder")}
        entries = cogvideox.autoencoder_table(params)
    else:
        params = load_weights(source / part / "weights", shapes(saved_architecture(model)))
        settings, entries = cogvideox.transformer_settings(model), cogvideox.transformer_table(model)
    tensors = to_tensors(params, entries)
    beside, cure = out.parent / cogvideox.CONFIG, "write to an empty directory"
    if beside.exists() and read_json(beside, cure=cure) != settings:
        raise ConvertError(f"{beside}: exists with other settings; {cure}")
    write_safetensors(out, tensors, {})
    write_json(beside, settings)
    text = f"under their public names; settings in {cogvideox.CONFIG}{replaces}"
    return f"{out}: {len(tensors)} tensors of CogVideoX's {part}, {text}"


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
    names = [EMPTY, *dict.fromkeys([*tasks, *(_tasks(store) if store else ())])]
    if len(names) == 1:
        raise ConvertError(f"{out}: there are no tasks to embed; name them with --task, or a store with --store")
    try:
        torch, transformers = (importlib.import_module(name) for name in ("torch", "transformers"))
    except ImportError as error:
        raise ConvertError(
            f"{source}: embedding texts needs transformers and PyTorch ({error}); pip install -e '.[text]'"
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
    made, fixed = [], {"padding": "max_length", "max_length": tokens, "truncation": True, "return_tensors": "pt"}
    with torch.no_grad():
        for name in names:
            made.append(encoder.eval()(tokenizer(name, **fixed).input_ids)[0].float().numpy())
    embeddings = np.concatenate(made)
    write_file(out, write_texts(names, embeddings))
    return [
        f"{out}: {len(names)} texts of {tokens} tokens of {embeddings.shape[2]} numbers, the empty one first{replaces}"
    ]


def _tasks(store: Path) -> list[str]:
    """Returns the tasks of a store's clips, in words."""
    opened = open_store(store)
    splits = [split for split in opened.splits if opened.labelled(split)]
    tasks = [word for split in splits for word in opened.labels(split).words.get("task", ())]
    if not splits:
        tasks = [opened.source(split)[i]["task"] for split in opened.splits for i in range(len(opened.source(split)))]
    return [task for task in dict.fromkeys(tasks) if task != UNKNOWN]
