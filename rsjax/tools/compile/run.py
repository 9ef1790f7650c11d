"""Compiles a part of a preset for a cluster, and looks for the largest batch that fits."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rich.console import Console

from rsjax.config import Config
from rsjax.errors import UserError
from rsjax.tools.compile import targets
from rsjax.tools.compile.programs import Part, Program, programs
from rsjax.tools.compile.report import (
    Compiled,
    TooLargeError,
    capacity,
    compile_program,
    figures,
    largest_batch,
    memory_note,
)
from rsjax.tools.compile.targets import Target

SECTIONS = {"train": "train", "tokenizer": "tokenizer_train"}  # of the batch size


def run(
    config: Config,
    target: Target,
    part: Part,
    clips: int,
    console: Console,
    find_largest: bool = True,
    keep: Callable[[str], None] = lambda text: None,
) -> list[dict[str, Any]]:
    """Compiles the programs of a part, and returns the figures of each.

    Args:
        clips: that the part "sample" generates at once.
        console: shows the progress.
        find_largest: also compile a second batch size, from which the largest batch that fits is extrapolated.
        keep: is given the text of each optimised program.

    Raises:
        ConfigError: the devices or the batch cannot be divided as the settings require.
        UserError: the compiler refuses a program.
        TooLargeError: a training step does not fit, by the compiler's own count.
    """
    devices = targets.devices(target)
    results = []
    for program in programs(config, part, devices, clips):
        try:
            compiled = compile_program(program, target, console)
        except TooLargeError as error:
            if not program.steps:
                raise
            raise TooLargeError(f"{error}; {_cure(config, part, target, devices, program, console)}") from error
        keep(compiled.text)
        numbers = figures(program, target, compiled)
        if program.steps and (find_largest or not numbers["fits"]):
            numbers |= _largest(config, part, target, devices, program, compiled, console)
        numbers["notes"] += memory_note(numbers, target)
        results.append(numbers)
    return results


def too_large(numbers: dict[str, Any], config: Config, part: Part, target: Target) -> str:
    """Returns one line on a training step that does not fit, with the cure."""
    there = f"{numbers['memory_bytes'] / 1e9:.1f} GB on each device, of which it may use {capacity(target) / 1e9:.1f}"
    batch = numbers.get("largest_batch", 0)
    line = f"{config.name}: {numbers['program']} needs {there}"
    if batch:
        return (
            f"{line}; the largest batch that fits is {batch}: --{SECTIONS[part].replace('_', '-')}.batch-size {batch}"
        )
    excess = numbers.get("smallest_batch_bytes", numbers["memory_bytes"]) - capacity(target)
    return f"{line}; {_split_state(config, target, numbers['state_bytes'], excess)}"


def _split_state(config: Config, target: Target, state: float, excess: float) -> str:
    """Names the least fsdp with which a state's parts leave enough room.

    Args:
        excess: bytes that the smallest batch takes beyond the memory.
    """
    now = config.runtime.fsdp
    for parts in (2**power for power in range(1, 12)):
        # Gradients are split as the parameters are, about a third of the state.
        saved = state * now * (1 / now - 1 / parts) * 4 / 3
        if parts > now and target.devices % parts == 0 and saved >= excess:
            return f"the state split into {parts} parts would fit: --runtime.sharding mesh --runtime.fsdp {parts}"
    return "nor does a smaller batch fit; choose a larger cluster or a smaller model"


def _with_batch(config: Config, part: Part, batch: int) -> Config:
    section = SECTIONS[part]
    return replace(config, **{section: replace(getattr(config, section), batch_size=batch)})


def _largest(
    config: Config,
    part: Part,
    target: Target,
    devices: list[Any],
    program: Program,
    compiled: Compiled,
    console: Console,
) -> dict[str, Any]:
    """Returns the largest batch that fits, from the memory of this batch and of another one."""
    step = program.devices * getattr(config, SECTIONS[part]).accumulate
    other = program.count // step // 2 * step or 2 * program.count
    try:
        second = programs(_with_batch(config, part, other), part, devices, 1)[0]
        needed = {program.count: compiled.needed, other: compile_program(second, target, console).needed}
    except TooLargeError:
        fits = compiled.needed <= capacity(target)
        return {"largest_batch": program.count * fits, "largest_batch_from": f"{other} does not"}
    small, large = sorted(needed)
    per_clip = (needed[large] - needed[small]) / (large - small)
    return {
        "largest_batch": largest_batch(needed, capacity(target), step),
        "smallest_batch_bytes": needed[small] - per_clip * (small - step),
        "largest_batch_from": f"extrapolated from the memory of {min(needed)} and {max(needed)}, both compiled",
    }


def _cure(config: Config, part: Part, target: Target, devices: list[Any], program: Program, console: Console) -> str:
    """Halves the batch until it fits, and returns what to set."""
    step = program.devices * getattr(config, SECTIONS[part]).accumulate
    batch = program.count
    while batch > step:
        batch = max(step, batch // 2 // step * step)
        try:
            smaller = programs(_with_batch(config, part, batch), part, devices, 1)[0]
            compiled = compile_program(smaller, target, console)
        except TooLargeError:
            continue
        found = _largest(_with_batch(config, part, batch), part, target, devices, smaller, compiled, console)
        flag = f"--{SECTIONS[part].replace('_', '-')}.batch-size"
        most = min(found["largest_batch"], program.count - step)
        return f"the largest batch that fits is about {max(batch, most)}: {flag} {max(batch, most)}"
    return _split_state(config, target, program.state_bytes, program.state_bytes / 2)


def check(results: list[dict[str, Any]], config: Config, part: Part, target: Target) -> None:
    """Raises :class:`TooLargeError` if a compiled program does not fit into the memory."""
    for numbers in results:
        if not numbers["fits"] and part in SECTIONS:
            raise TooLargeError(too_large(numbers, config, part, target))
        if not numbers["fits"]:
            raise UserError(f"{numbers['program']} does not fit into the memory of {target.card.title}; lower --clips")
