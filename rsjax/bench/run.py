"""A whole benchmark: the parts in order, facts about the machine, the table."""

import datetime
import os
import platform
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
from rich.table import Table

from rsjax.bench import parts
from rsjax.bench.feed import feed
from rsjax.bench.timing import peak_memory_bytes
from rsjax.bench.torch_part import check_torch, torch_baseline
from rsjax.config import Config, ConfigError
from rsjax.errors import did_you_mean

PARTS = ("matmul", "train", "sample", "tokenizer", "loader", "feed")
BUDGET_SECONDS = 20.0  # for each quantity, if three runs take no longer


def bench(
    config: Config,
    batch: int = 1,
    only: Sequence[str] = PARTS,
    horizons: tuple[int, ...] = (),
    torch: bool = False,
    budget: float = BUDGET_SECONDS,
    say: Callable[[str], None] = lambda line: None,
    keep: Callable[[dict[str, Any]], None] = lambda numbers: None,
) -> dict[str, Any]:
    """Measures the parts named in ``only``, one after the other, in this process.

    Args:
        batch: clips in a training step, a rollout and a loader's batch; the tokenizer gets their frames. The part
            ``feed`` trains with the preset's own.
        horizons: frames of the rollouts, their one prompt frame included; the model's own number and three times that
            if empty. PyTorch decodes in a window of the first.
        torch: time the PyTorch baseline too.
        budget: seconds after which a quantity's repetitions end, once there are three.
        say: told what is measured, before it is.
        keep: given after each part all numbers so far, as they would be returned: the next part may run out of memory.

    Returns:
        Flat and JSON-ready: what was measured, and on what. Peak memory is the high-water mark up to each part's end.

    Raises:
        UserError: a part is unknown, the batch is not positive, a rollout has nothing to generate, or torch is asked
            for and is not there or cannot be this model.
    """
    check_request(config, batch, only, horizons, torch)
    horizons = horizons or (config.model.frames, 3 * config.model.frames)
    works: dict[str, Callable[[], dict[str, Any]]] = {
        "matmul": lambda: parts.matmul(config.model.compute_dtype, budget),
        "train": lambda: parts.train(config, batch, budget),
        "sample": lambda: parts.sample(config, batch, budget, horizons),
        "tokenizer": lambda: parts.tokenizer(config, batch, budget),
        "loader": lambda: parts.load(config, batch, budget),
        "feed": lambda: feed(config, budget),
        "torch": lambda: torch_baseline(config, batch, budget, horizons[0]),
    }
    numbers = facts(config, batch)
    for name in [part for part in PARTS if part in only] + ["torch"] * torch:
        say(f"measuring {name}")
        numbers |= works[name]() | {"peak_memory_bytes": peak_memory_bytes()}
        if name != "torch":  # whose memory on an accelerator jax does not see
            numbers[f"{name}_peak_memory_bytes"] = numbers["peak_memory_bytes"]
        numbers |= ratios(numbers, config.model.depth)
        keep(dict(numbers))
    return numbers


def check_request(config: Config, batch: int, only: Sequence[str], horizons: Sequence[int], torch: bool) -> None:
    """Raises :class:`UserError` for what cannot be measured, before anything is."""
    for name in only:
        if name not in PARTS:
            raise ConfigError(f"--only has no part {name!r}{did_you_mean(name, PARTS)} (parts: {', '.join(PARTS)})")
    if batch < 1:
        raise ConfigError(f"--batch is {batch}; at least 1 clip is needed")
    for frames in horizons:
        if frames <= parts.PROMPT_FRAMES:
            raise ConfigError(
                f"--horizons has {frames}; the prompt is {parts.PROMPT_FRAMES} frame, and one must follow"
            )
    if torch:
        check_torch(config.model)


def ratios(numbers: dict[str, Any], dual: bool) -> dict[str, float]:
    """What follows from two measured quantities, where both are there."""
    over = {
        "train_share_of_ceiling": ("train_flops", "matmul_ceiling_flops"),
        "sample_cache_speedup": ("sample_s_per_frame_uncached", "sample_s_per_frame_cached"),
    }
    same_device = (numbers.get("torch_device") == "cpu") == (numbers.get("platform") == "cpu")
    if same_device and not dual:  # the PyTorch baseline is one branch: only then do both do the same work
        for dtype in ("float32", "bfloat16"):
            over[f"train_speedup_over_torch_{dtype}"] = (f"torch_train_step_s_{dtype}", "train_step_s")
            over[f"sample_speedup_over_torch_{dtype}"] = (
                f"torch_sample_s_per_frame_{dtype}",
                "sample_s_per_frame_cached",
            )
    return {name: numbers[a] / numbers[b] for name, (a, b) in over.items() if a in numbers and b in numbers}


def facts(config: Config, batch: int) -> dict[str, Any]:
    """What was measured, on what, and when."""
    device = jax.local_devices()[0]
    return {
        "preset": config.name,
        "batch": batch,
        "blocks": config.model.blocks,
        "width": config.model.width,
        "branches": 2 if config.model.depth else 1,
        "frames": config.clips.frames,
        "dtype": config.model.compute_dtype,
        "remat": config.model.remat,
        "device": _cpu_model() if device.platform == "cpu" else device.device_kind,
        "platform": device.platform,
        "cores": len(os.sched_getaffinity(0)),
        "jax": jax.__version__,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
    }


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def table(numbers: dict[str, Any]) -> Table:
    """The same for a terminal."""
    out = Table(show_header=False, box=None)
    for name, value in numbers.items():
        out.add_row(name, _shown(name, value))
    return out


def _shown(name: str, value: Any) -> str:
    if name.endswith("_bytes"):
        return f"{value / 2**20:,.0f} MiB"
    if not isinstance(value, float):
        return str(value)
    if name.endswith("_share"):
        return f"{value:.2%}"
    if "_flops" in name:
        return f"{value / 1e9:,.1f} GFLOP/s"
    if name.endswith("_per_s"):
        return f"{value:,.1f} /s"
    if "_s_" in name or name.endswith("_s"):
        return f"{value:,.3f} s" if value >= 1 else f"{1e3 * value:,.2f} ms"
    return f"{value:,.3f}"
