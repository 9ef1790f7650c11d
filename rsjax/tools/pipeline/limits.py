"""Refuses, before it begins, work that cannot fit into memory or onto the disk; all estimates are lower bounds."""

import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Literal

import jax

from rsjax.config import Config, SimConfig, TrainConfig, TransformerConfig
from rsjax.errors import UserError

GIB = 2**30
_CGROUPS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


def host_memory() -> int:
    """Returns the bytes of memory that this process may use."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for path in map(Path, _CGROUPS):
        with suppress(OSError, ValueError):  # "max" means no limit
            limits.append(int(path.read_text()))
    return min(limits)


def device_memory() -> int:
    """Returns the bytes of memory of each of this process's devices; on a CPU, the device's share of host memory."""
    devices = jax.local_devices()
    limits = [(device.memory_stats() or {}).get("bytes_limit", 0) for device in devices]
    return min(limits) or host_memory() // len(devices)


def check_batch(config: Config, loop: TrainConfig, stage: Literal["tokenizer", "world_model"]) -> None:
    """Raises :class:`UserError` if a batch's activations cannot fit into the devices' memory."""
    # At least this many bytes a clip for the backward pass: features of one layer, or inputs of blocks.
    if stage == "world_model":
        clip_bytes = config.clips.frames * _frame_bytes(config)
    elif config.autoencoder is config.tokenizer:
        cells = (config.clips.image_size // config.tokenizer.patch_size) ** 2
        clip_bytes = 2 * config.tokenizer_train.frames_per_clip * cells * config.tokenizer.channels
    else:
        clip_bytes = config.tokenizer_train.frames_per_clip * config.clips.image_size**2
    clips = loop.batch_size / (loop.accumulate * jax.device_count())
    needed = int(clips * clip_bytes)
    there = device_memory()
    if needed > there:
        section = "tokenizer_train" if stage == "tokenizer" else "train"
        raise UserError(
            f"{section}.batch_size is {loop.batch_size}, whose activations take more than {needed / GIB:,.0f} GiB on "
            f"each of {jax.device_count()} devices with {there / GIB:,.0f} GiB; lower it, or raise "
            f"{section}.accumulate (rsjax describe estimates the bytes of a clip)"
        )


def _frame_bytes(config: Config) -> int:
    """Returns bytes that a world model needs for each frame: the inputs of its blocks, or at least the picture."""
    if isinstance(config.model, TransformerConfig):
        return 2 * config.model.blocks * config.grid**2 * config.model.width
    return config.clips.image_size**2


def check_together(config: Config, clips: int, frames: int, options: str) -> None:
    """Raises :class:`UserError` if a world model cannot hold this many clips of this many frames in memory at once.

    A generated clip that is longer than those of the training takes the memory of its window.

    Args:
        options: the options that say so, with their values.
    """
    needed = clips * min(frames, config.clips.frames) * _frame_bytes(config)
    there = device_memory()
    if needed > there:
        raise UserError(
            f"{options}: so much at once takes more than {needed / GIB:,.0f} GiB on a device with "
            f"{there / GIB:,.0f} GiB; lower it"
        )


def check_rollout(config: Config, frames: int) -> None:
    """Raises :class:`UserError` if a generated video of one clip cannot fit into memory."""
    pixel_bytes = 3 + 4 * config.model.uses_depth
    needed = frames * config.clips.image_size**2 * pixel_bytes
    there = host_memory()
    if needed > there:
        raise UserError(
            f"--frames is {frames}, a video of {needed / GIB:,.0f} GiB; this machine has {there / GIB:,.0f} GiB of "
            f"memory; generate fewer"
        )


def check_episodes(config: SimConfig, out: Path, option: str = "sim.episodes") -> None:
    """Raises :class:`UserError` if simulated episodes cannot fit onto the disk, at one byte per pixel or more."""
    place = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    needed = config.episodes * config.frames * config.image_size**2
    free = shutil.disk_usage(place).free
    if needed > free:
        raise UserError(
            f"{option} is {config.episodes}, which takes more than {needed / GIB:,.0f} GiB; {place} has "
            f"{free / GIB:,.0f} GiB free; lower it, or choose another --data-dir"
        )
