"""Runs a benchmark's parts in order, with facts about the machine, and formats the table."""

import datetime
import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
from rich.table import Table

from rsjax.config import Config, require
from rsjax.config.config_fields import config_fields
from rsjax.devices import device_name
from rsjax.errors import did_you_mean
from rsjax.tools.bench import inputs, parts
from rsjax.tools.bench.roofline import roofline
from rsjax.tools.bench.timing import peak_memory_bytes
from rsjax.tools.pipeline.limits import check_together

PARTS = ("matmul", "train", "roofline", "sample", "tokenizer", "environment", "loader", "feed")
MODEL_FACTS = ("blocks", "width", "depth", "compute_dtype", "remat")  # reported if the family has them
Rival = Callable[[Config, int, float, int], dict[str, Any]]  # of configuration, batch, seconds, frames of a rollout
BUDGET_SECONDS = 20.0  # per quantity, unless three runs take longer


def bench(
    config: Config,
    batch: int = 1,
    only: Sequence[str] = PARTS,
    horizons: tuple[int, ...] = (),
    rival: Rival | None = None,
    budget: float = BUDGET_SECONDS,
    say: Callable[[str], None] = lambda line: None,
    keep: Callable[[dict[str, Any]], None] = lambda numbers: None,
) -> dict[str, Any]:
    """Measures the parts named in ``only`` one after another in this process.

    Args:
        batch: clips per training step, rollout and loader batch; the tokenizer processes their frames. The part
            ``feed`` uses the preset's batch size.
        horizons: lengths of rollouts in frames, including one prompt frame; if empty, once and three times the clips'
            length. The rival decodes in a window of the first length.
        rival: measures the same model in PyTorch; None: only ours.
        budget: seconds after which repetitions of a quantity end, but at least three are run.
        say: takes a message before each part.
        keep: takes all numbers so far after each part, since the next part may run out of memory.

    Returns:
        Numbers and facts about model and machine, flat and JSON-ready. Peak memory is the maximum up to a part's end.

    Raises:
        UserError: a part is unknown, the batch is not positive or does not fit into memory, or a rollout has nothing
            to generate.
    """
    check_request(config, batch, only, horizons)
    with inputs.random_files(config) as config:
        horizons = horizons or (config.clips.frames, 3 * config.clips.frames)
        numbers = facts(config, batch)

        def add(name: str, measured: dict[str, Any]) -> None:
            peak = {"peak_memory_bytes": peak_memory_bytes()}
            if name != "torch":  # jax does not see torch's memory on an accelerator
                peak[f"{name}_peak_memory_bytes"] = peak["peak_memory_bytes"]
            numbers.update(measured | peak)
            branches = config.model.uses_depth and config.model.family == "roboscape"
            numbers.update(ratios(numbers, branches))
            keep(dict(numbers))

        for name in PARTS:
            if name in only:
                say(f"measuring {name}")
                add(name, measure_part(name, config, batch, budget, horizons, numbers))
        if rival is not None:
            say("measuring torch")
            ours: dict[str, Any] = {}
            if "train" in only:
                ours = parts.train_adamw(config, batch, budget)
            add("torch", ours | rival(config, batch, budget, horizons[0]))
    return numbers


def measure_part(
    name: str, config: Config, batch: int, budget: float, horizons: tuple[int, ...], before: dict[str, Any]
) -> dict[str, Any]:
    """Measures one of :data:`PARTS`; ``before`` holds the numbers of the parts before it."""
    match name:
        case "matmul":
            return parts.matmul(getattr(config.model, "compute_dtype", "float32"), budget)
        case "train":
            return parts.train(config, batch, budget)
        case "roofline":
            return roofline(config, batch, before["matmul_ceiling_flops"], budget)
        case "sample":
            return parts.sample(config, batch, budget, horizons)
        case "tokenizer":
            return parts.tokenizer(config, batch, budget)
        case "environment":
            return parts.environment(config, budget)
        case "loader":
            return parts.load(config, batch, budget)
        case "feed":
            return parts.feed(config, budget)
    raise ValueError(f"no part {name!r}")


def check_request(config: Config, batch: int, only: Sequence[str], horizons: Sequence[int]) -> None:
    """Raises :class:`UserError` if any part cannot be measured; called before the first measurement."""
    for name in only:
        known = f"{did_you_mean(name, PARTS)} (parts: {', '.join(PARTS)})"
        require(name in PARTS, f"--only has no part {name!r}{known}")
    needs = "--only roofline needs the ceiling of matrix products too: --only matmul,roofline"
    require("roofline" not in only or "matmul" in only, needs)
    require(batch >= 1, f"--batch is {batch}; at least 1 clip is needed")
    for frames in horizons:
        problem = f"--horizons has {frames}; a rollout has {parts.PROMPT_FRAMES} prompt frame, so it needs at least 2"
        require(frames > parts.PROMPT_FRAMES, problem)
    check_together(config, batch, config.clips.frames, f"--batch {batch}")


def ratios(numbers: dict[str, Any], dual: bool) -> dict[str, Any]:
    """Returns ratios of measured quantities, each if both of its quantities were measured.

    PyTorch's quantity is the faster of the plain one and its variant, if there is one; ``…_fastest_torch_…`` says which
    is faster. PyTorch's training step uses AdamW, so it is compared with our step with AdamW.
    """
    over = {
        "train_share_of_ceiling": ("train_flops", "matmul_ceiling_flops"),
        "sample_cache_speedup": ("sample_s_per_frame_uncached", "sample_s_per_frame_cached"),
    }
    chosen = {}

    def fastest(part: str, quantity: str, dtype: str, variant: str) -> str:
        plain = f"torch_{quantity}_{dtype}"
        if (name := f"{plain}_{variant}") not in numbers:
            return plain
        gains = (numbers[name] > numbers[plain]) == quantity.endswith("_per_s")
        if gains:
            chosen[f"{part}_fastest_torch_{dtype}"] = variant
            return name
        chosen[f"{part}_fastest_torch_{dtype}"] = "eager"
        return plain

    same_device = (numbers.get("torch_device") == "cpu") == (numbers.get("platform") == "cpu")
    if same_device and not dual:  # the PyTorch baseline has only one branch
        for dtype in ("float32", "bfloat16"):
            theirs = fastest("train", "train_step_s", dtype, "compiled")
            ours = "train_step_s"
            if "train_step_s_adamw" in numbers:
                ours = "train_step_s_adamw"
            over[f"train_speedup_over_torch_{dtype}"] = (theirs, ours)
            over[f"sample_speedup_over_torch_{dtype}"] = (
                f"torch_sample_s_per_frame_{dtype}",
                "sample_s_per_frame_cached" if "sample_s_per_frame_cached" in numbers else "sample_s_per_frame",
            )
            for part in ("tokenizer_encode", "tokenizer_decode"):
                rate = f"{part}_frames_per_s"
                theirs = fastest(part, rate, dtype, "channels_last")
                over[f"{part}_speedup_over_torch_{dtype}"] = (rate, theirs)
    return chosen | {name: numbers[a] / numbers[b] for name, (a, b) in over.items() if a in numbers and b in numbers}


def facts(config: Config, batch: int) -> dict[str, Any]:
    """Returns facts about the model, the machine and the date."""
    model = config_fields(config.model)
    return {
        "preset": config.name,
        "batch": batch,
        "model": config.model.family,
        "frames": config.clips.frames,
        **{name: model[name].value for name in MODEL_FACTS if name in model},
        "device": device_name(),
        "platform": jax.local_devices()[0].platform,
        "cores": len(os.sched_getaffinity(0)),
        "jax": jax.__version__,
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
    }


def terminal_table(numbers: dict[str, Any]) -> Table:
    """Formats numbers for a terminal."""
    out = Table(show_header=False, box=None)
    for name, value in numbers.items():
        out.add_row(name, _shown(name, value))
    return out


def _shown(name: str, value: Any) -> str:
    if name.endswith("_bytes_per_s"):
        return f"{value / 1e9:,.1f} GB/s"
    if name.endswith("_bytes"):
        return f"{value / 2**20:,.0f} MiB"
    if not isinstance(value, float):
        return str(value)
    if name.endswith("_share"):
        return f"{value:.2%}"
    if "_flops" in name:
        return f"{value / 1e9:,.1f} GFLOP/s"
    if "_per_s" in name:
        return f"{value:,.1f} /s"
    if "_s_" in name or name.endswith("_s"):
        if value >= 1:
            return f"{value:,.3f} s"
        return f"{1e3 * value:,.2f} ms"
    return f"{value:,.3f}"
