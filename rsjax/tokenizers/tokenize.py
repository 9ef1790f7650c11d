"""Tokenizes a store of clips, once for all runs with the same tokenizer.

The tokens are in ``tokens/KEY`` of the store's directory and move with it. A token record is a clip's record with
tokens instead of pixels, and without ``success`` if the data set does not record it; actions stay in the data's units.
The manifest lists unreadable clips, which have no tokens.
"""

import hashlib
import os
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.clip import UNKNOWN
from rsjax.data.clips import first_clip, readable
from rsjax.data.codec import Record
from rsjax.data.quarantine import NAME as QUARANTINE
from rsjax.data.quarantine import Quarantine
from rsjax.data.shift import moved
from rsjax.data.state_labels import knows_success
from rsjax.data.store import Store, StoreError, open_store, write_store
from rsjax.data.token_sets import FOLDER, OWN, tokenizer_key, tokens_key
from rsjax.files import lock_file, making
from rsjax.progress import Progress, note
from rsjax.tokenizers.codec import Codec
from rsjax.trainable import Params

UNITS = ("action_mean", "action_std", "action_count", "depth_range", "depth_unit")  # manifest entries that are copied
_LEFT_OUT = "left_out"  # manifest entry: numbers of the clips without tokens by split


def tokenize_store(
    clips: Store, codec: Codec, image_size: int, place: Path, max_damaged: float, shifts: tuple[int, ...] = ()
) -> Store:
    """Makes the tokens of every clip, unless they exist.

    Args:
        codec: the trained tokenizer.
        image_size, place, max_damaged: as for :func:`prepare_store`, whose errors it raises.
        shifts: how many moved copies each training clip has, and how far they are moved at most, in pixels; empty:
            none.
    """

    def encode(clip: Record) -> Record:
        return token_record(codec, clip)

    def copies(clip: Record) -> Record:
        return shifted_tokens(codec, clip, *shifts)

    sized = (image_size, place, max_damaged)
    return prepare_store(clips, codec.config, codec.params, encode, *sized, copies if shifts else None, shifts)


def prepare_store(
    clips: Store,
    config: Any,
    params: Params,
    encode: Callable[[Record], Record],
    image_size: int,
    place: Path,
    max_damaged: float,
    more: Callable[[Record], Record] | None = None,
    more_key: tuple[int, ...] = (),
) -> Store:
    """Makes the store of every clip's tokens or latents, unless it exists.

    Args:
        config: the autoencoder's settings (``Config.autoencoder``).
        params: its trained parameters.
        encode: returns a clip's token record, with the fields of :func:`described` besides its tokens or latents.
        image_size: pixels per side of its images.
        place: a directory for the list of damaged clips, and for the tokens if the store is write-protected.
        max_damaged: the share of a split's clips that may be damaged.
        more: returns further fields of a training clip's token record.
        more_key: numbers that these further fields depend on.

    Returns:
        The store of tokens.

    Raises:
        StoreError: clips have another size than the tokenizer's images, too many are damaged, or the disk is full.
    """
    side = first_clip(clips)["rgb"].shape[1]
    if side != image_size:
        raise StoreError(f"{clips.path}: its pictures have {side} pixels a side, the tokenizer takes {image_size}")
    (place / QUARANTINE).unlink(missing_ok=True)  # all clips are checked again
    weights = fingerprint(params)
    tokenizer = tokenizer_key(config, weights, *more_key)
    key = tokens_key(str(clips.manifest.get("key")), tokenizer)
    out = clips.path.resolve() / FOLDER / tokenizer
    beside = out
    if _is_made(beside, key, clips):
        return _listed(beside, clips, max_damaged, place)
    parent = next(folder for folder in beside.parents if folder.exists())
    lock = lock_file(beside)
    if not os.access(parent, os.W_OK) or (lock.exists() and not os.access(lock, os.W_OK)):  # another user's store
        out = place.resolve() / OWN / tokenizer
    with making(out, wait=True):
        if not _is_made(out, key, clips):
            _write(out, clips, encode, more, {"key": key, "tokenizer": weights, "shifts": more_key})
    return _listed(out, clips, max_damaged, place)


def _is_made(out: Path, key: str, clips: Store) -> bool:
    """Returns whether these tokens are complete: no clip without tokens has become readable since."""
    try:
        manifest = open_store(out).manifest
    except StoreError:
        return False
    missing = manifest.get(_LEFT_OUT, {})
    repaired = (readable(clips.source(split), numbers, lambda _: None) for split, numbers in missing.items())
    return manifest.get("key") == key and not any(next(records, None) for records in repaired)


def _write(
    out: Path,
    clips: Store,
    encode: Callable[[Record], Record],
    more: Callable[[Record], Record] | None,
    keys: dict[str, Any],
) -> None:
    total = sum(len(clips.source(split)) for split in clips.splits)
    says_success = knows_success(clips)
    left_out: dict[str, list[int]] = {split: [] for split in clips.splits}
    with Progress("tokens", total, "clips") as progress:
        done = 0

        def tokenized(split: str) -> Iterator[Record]:
            nonlocal done
            source = clips.source(split)
            missing = set(range(len(source)))
            for number, clip in readable(source, tell=lambda _: None):
                missing.remove(number)
                record = encode(clip) | (more(clip) if more and split == "train" else {})
                if says_success:
                    record["success"] = clip["success"]
                yield record
                done += 1
                progress.update(done)
            left_out[split] = sorted(missing)

        meta = {name: clips.manifest[name] for name in UNITS if name in clips.manifest}
        meta |= keys | {"source": str(clips.path), _LEFT_OUT: left_out}
        write_store(out, "tokens", {split: tokenized(split) for split in clips.splits}, meta, labels)


def _listed(path: Path, clips: Store, max_damaged: float, place: Path) -> Store:
    """Opens the store of tokens and lists clips without tokens; raises if too many, or any of the test split."""
    tokens = open_store(path)
    for split, numbers in tokens.manifest.get(_LEFT_OUT, {}).items():
        source = clips.source(split)
        quarantine = Quarantine(place / QUARANTINE, len(source), max_damaged)
        for number in numbers:
            try:
                source[number]
            except StoreError as error:
                if split == "test":
                    raise
                quarantine.note(source.locate(number), error, instead="it has no tokens")
        if numbers:
            note(f"{len(numbers)} of {len(source)} clips cannot be read and have no tokens: {place / QUARANTINE}")
    return tokens


def token_record(codec: Codec, clip: Record) -> Record:
    """Returns a clip's token record; depth is None if the clip has none, and "second" is left out."""
    record = {
        "rgb": codec.encode_rgb(clip["rgb"]),
        "depth": None if clip["depth"] is None else codec.encode_depth(clip["depth"]),
        **described(clip),
    }
    if "second" in clip:
        record["second"] = codec.encode_rgb(clip["second"])
    return record


def shifted_tokens(codec: Codec, clip: Record, count: int, pixels: int) -> Record:
    """Returns the tokens of a clip's moved copies; the moves depend only on the clip's pixels.

    The second view does not move with the first.

    Returns:
        ``shifts``, the moves to the right and down in widths of the image (count, 2), and ``rgb_shifted`` and
        ``depth_shifted``, the copies' tokens (count, T, h, w).
    """
    rng = np.random.default_rng(zlib.crc32(clip["rgb"].tobytes()))
    moves = rng.integers(-pixels, pixels + 1, (count, 2))
    rgb = codec.encode_rgb(np.stack([moved(clip["rgb"], *move) for move in moves]))
    depth = clip["depth"]
    if depth is not None:
        depth = codec.encode_depth(np.stack([moved(depth, *move) for move in moves]))
    side = clip["rgb"].shape[2]
    return {"shifts": (moves / side).astype(np.float32), "rgb_shifted": rgb, "depth_shifted": depth}


def described(clip: Record) -> Record:
    """Returns the fields that a clip's token record has besides its tokens: actions, tracks, labels."""
    return {
        "actions": clip["actions"],
        "tracks": clip["tracks"],
        "visible": clip["visible"],
        "task": clip["task"],
        "difficulty": clip["provenance"].get("difficulty", UNKNOWN),
        "provenance": clip["provenance"],
    }


def labels(record: Record) -> dict[str, str]:
    """Returns the labels by which a curriculum selects token records."""
    scene = record["provenance"].get("scene") or UNKNOWN
    return {"task": record["task"] or UNKNOWN, "difficulty": record["difficulty"], "scene": scene}


def fingerprint(params: Params) -> str:
    """Returns 16 hex digits of all weights, which identify a tokenizer."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(params):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()[:16]
