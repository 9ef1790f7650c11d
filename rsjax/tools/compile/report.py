"""Compiles programs, and reports what a cluster can do with them at most."""

import re
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.errors import JaxRuntimeError
from jax.sharding import AbstractMesh, Mesh
from rich import box
from rich.console import Console, Group, RenderableType
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from rsjax.errors import UserError, first_line
from rsjax.files import write_file
from rsjax.layers.platform import for_all_platforms
from rsjax.progress import duration
from rsjax.tools.compile.programs import Program
from rsjax.tools.compile.roofline import Roofline, part_of, roofline
from rsjax.tools.compile.targets import Target, devices

LAUNCH_SECONDS = 3e-6  # of a kernel on a GPU; 2 to 5 µs
GPU_SHARE = 0.92  # of a GPU's memory that XLA can use; the rest is the driver's and the libraries'
DEFAULT_SHARE = 0.75  # what jax takes of it without XLA_PYTHON_CLIENT_MEM_FRACTION
TOP = 10

BOUND = (
    "A bound, not a measurement: each kernel at the card's data-sheet peak or bandwidth, counted from the compiled "
    "program. Real steps take longer; {}."
)


class TooLargeError(UserError):
    """A program needs more memory than the card has."""


class Compiled(NamedTuple):
    """A compiled program.

    Attributes:
        needed: bytes of memory on each device.
        temporaries: bytes of them besides state and batch.
    """

    text: str
    needed: int
    temporaries: int
    seconds: float


def compile_program(program: Program, target: Target, console: Console) -> Compiled:
    """Traces and compiles a program, and shows that this goes on.

    Raises:
        TooLargeError: the compiler finds that it needs more memory than the card has.
        UserError: the compiler refuses it; the message is its first line and names a file with the rest.
    """
    began = time.monotonic()
    one = Mesh(np.array(devices(target)[:1]), ("device",)).abstract_mesh
    kind = AbstractMesh((), (), abstract_device=one.abstract_device)
    with (
        _shown(f"compiling for {target.title}: {program.title}", console),
        for_all_platforms(),
        # Kernels are lowered for the kind of device that a mesh names, if only one without axes, which shards nothing.
        # Without it, jax 0.11 looks for a GPU here.
        jax.sharding.use_abstract_mesh(kind),
        tempfile.TemporaryDirectory() as folder,
    ):
        options: dict[str, Any] = {}
        if target.card.platform == "tpu":
            options = {"xla_dump_to": folder, "xla_dump_hlo_as_text": True}
        try:
            compiled = program.lower().compile(compiler_options=options)
        except JaxRuntimeError as error:
            text = str(error)
            exceeded = re.search(r"Used ([\d.]+\w) of ([\d.]+\w) hbm", text)
            if exceeded:
                raise TooLargeError(
                    f"{program.title}: needs {exceeded[1]}iB of memory on each device; {target.card.title} has "
                    f"{exceeded[2]}iB"
                ) from error
            path = Path(tempfile.gettempdir()) / "rsjax-compile-error.txt"
            write_file(path, text.encode())
            raise UserError(
                f"the compiler refuses this: {program.title}, for {target.name}: {first_line(error)} (all: {path})"
            ) from error
        if target.card.platform == "tpu":
            # jax cannot read back a TPU's program in which collectives are fused with kernels, so its compiler writes.
            text = next(Path(folder).glob("*.after_codegen.txt")).read_text()
        else:
            text = compiled.as_text()
    memory = compiled.memory_analysis()
    kept = memory.argument_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes
    temporaries = memory.temp_size_in_bytes
    return Compiled(text, kept + temporaries, temporaries, time.monotonic() - began)


@contextmanager
def _shown(line: str, console: Console) -> Iterator[None]:
    if not console.is_terminal:
        console.print(line, highlight=False, soft_wrap=True)
        yield
        return
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        progress.add_task(line)
        yield


def capacity(target: Target) -> float:
    """Returns the bytes that a program may use on each device."""
    if target.card.platform == "cuda":
        return GPU_SHARE * target.card.memory
    return target.card.memory


def figures(program: Program, target: Target, compiled: Compiled) -> dict[str, Any]:
    """Returns the numbers of the report by name; bytes, kernels and seconds are those of one device."""
    cost = roofline(compiled.text, target.card, target.local)
    seconds = cost.seconds + cost.exposed
    numbers: dict[str, Any] = {
        "program": program.title,
        "target": target.name,
        "devices": program.devices,
        program.unit: program.count,
        "compile_s": round(compiled.seconds, 1),
        "roofline_s": cost.seconds,
        "exposed_s": cost.exposed,
        "roofline_mfu": program.model_flops / (target.card.peak * program.devices * cost.seconds),
        "model_flops": program.model_flops,
        "flops": cost.flops * program.devices,
        "bytes": cost.bytes,
        "kernels": cost.launches,
        "state_bytes": program.state_bytes,
        "temp_bytes": compiled.temporaries,
        "memory_bytes": compiled.needed,
        "fits": compiled.needed <= capacity(target),
        f"{program.unit}_per_s": program.count / seconds,
        "collectives": {kind: {"launches": n, "bytes": sent} for kind, (n, sent) in cost.collectives().items()},
        "bound_by": bound_by(cost, target),
        "warnings": list(cost.warnings),
        "notes": list(program.notes),
    }
    if program.steps:
        days = program.steps * seconds / 86400
        numbers |= {"steps": program.steps, "days": days, "device_hours": 24 * days * program.devices}
    parts = cost.by_part(part_of)
    numbers["parts"] = [
        {"part": name, "share": part.seconds / cost.seconds, "bytes": part.bytes, "kernels": part.launches}
        for name, part in parts.items()
    ]
    top = sorted(cost.kernels, key=lambda kernel: -kernel.launches * (kernel.seconds + kernel.exposed))[:TOP]
    operations = []
    for kernel in top:
        total = kernel.launches * (kernel.seconds + kernel.exposed)
        operations.append(
            {
                "part": part_of(kernel.op_name, 4),
                "operation": kernel.op_name.rpartition("/")[2] or kernel.opcode,
                "kernel": kernel.name,
                "seconds": total,
                "share": total / (cost.seconds + cost.exposed),
                "launches": kernel.launches,
                "bytes": kernel.bytes,
                "flops": kernel.flops,
                "sent": kernel.sent,
            }
        )
    numbers["operations"] = operations
    return numbers


def bound_by(cost: Roofline, target: Target) -> dict[str, float]:
    """Returns the shares of the bound that memory, products and the wait for collectives have.

    On a GPU also the time of launches, as a share of the bound; above 1, launches are what bounds it.
    """
    total = cost.seconds + cost.exposed
    memory = sum(kernel.total for kernel in cost.kernels if kernel.bytes / target.card.bandwidth >= kernel.seconds)
    shares = {
        "bandwidth": memory / total,
        "compute": (cost.seconds - memory) / total,
        "collectives": cost.exposed / total,
    }
    if target.card.platform == "cuda":
        shares["launches"] = cost.launches * LAUNCH_SECONDS / total
    return shares


def largest_batch(batches: dict[int, int], room: float, step: int) -> int:
    """Returns the largest batch whose memory fits, a multiple of ``step``, by a line through the two largest batches.

    Args:
        batches: the bytes that programs for these batches need on each device.
        room: the bytes that there are.
    """
    small, large = sorted(batches)[-2:]
    slope = max((batches[large] - batches[small]) / (large - small), 1e-9)
    most = large + (room - batches[large]) / slope
    return max(0, int(most // step * step))


def render(numbers: dict[str, Any], target: Target, title: str) -> RenderableType:
    """Returns the tables for a terminal."""
    unit = next(unit for unit in ("clips", "frames", "images") if f"{unit}_per_s" in numbers)
    table = Table(
        title=f"{title}: {numbers['program']} on {target.title}",
        title_justify="left",
        show_header=False,
        box=box.SIMPLE,
    )
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    for name, value in _rows(numbers, target, unit):
        table.add_row(name, value)
    parts = Table("", title="Where the time goes", title_justify="left", box=box.SIMPLE)
    for name in ("share", "memory traffic", "kernels"):
        parts.add_column(name, justify="right")
    for part in numbers["parts"][:TOP]:
        parts.add_row(part["part"], f"{part['share']:.1%}", _bytes(part["bytes"]), f"{part['kernels']:,}")
    operations = Table("", title=f"The {TOP} most expensive operations", title_justify="left", box=box.SIMPLE)
    for name in ("share", "launches", "ms each", "memory"):
        operations.add_column(name, justify="right")
    for one in numbers["operations"]:
        operations.add_row(
            f"{one['part']} {one['operation']}",
            f"{one['share']:.1%}",
            f"{one['launches']:,}",
            f"{one['seconds'] / one['launches'] * 1e3:.3g}",
            _bytes(one["bytes"]),
        )
    lines = [Text(f"note: {note}") for note in numbers["notes"]]
    lines += [Text(f"warning: {warning}", style="bold red") for warning in numbers["warnings"]]
    source = (
        f"{target.card.title}: {target.card.peak / 1e12:.0f} TFLOP/s of bf16, {target.card.bandwidth / 1e12:.2f} TB/s"
    )
    return Group(table, parts, operations, *lines, Text(BOUND.format(source)))


def _rows(numbers: dict[str, Any], target: Target, unit: str) -> Iterator[tuple[str, str]]:
    fits = "[bold red]does not fit[/]"
    if numbers["fits"]:
        fits = "fits"
    yield "compiles", f"in {duration(numbers['compile_s'])}"
    largest = ""
    if "largest_batch" in numbers:
        largest = f"; {numbers['largest_batch']:,} {unit} would fit ({numbers['largest_batch_from']})"
    yield (
        "memory a device",
        f"{_bytes(numbers['memory_bytes'])} of {_bytes(capacity(target))}: {fits} "
        f"(state {_bytes(numbers['state_bytes'])}, temporaries {_bytes(numbers['temp_bytes'])}){largest}",
    )
    bound = _seconds(numbers["roofline_s"])
    if numbers["exposed_s"]:
        bound += f", and {_seconds(numbers['exposed_s'])} of collectives beside which nothing runs"
    yield "roofline time", bound
    if numbers["model_flops"]:
        yield (
            "roofline MFU",
            f"{numbers['roofline_mfu']:.1%} (model {_scaled(numbers['model_flops'], 'FLOP')}, "
            f"executed {_scaled(numbers['flops'], 'FLOP')})",
        )
    rate = f"at most {numbers[f'{unit}_per_s']:,.1f} {unit} a second"
    if "days" in numbers:
        rate += (
            f"; {numbers['steps']:,} steps take at least {numbers['days']:.3g} days, "
            f"{numbers['device_hours']:,.3g} device-hours"
        )
    yield "speed", rate
    each = numbers["bytes"] * numbers["devices"] / numbers[unit]
    yield "memory traffic", f"{_bytes(numbers['bytes'])} a device, {_bytes(each)} for one of the {unit}"
    shares = numbers["bound_by"]
    named = ", ".join(f"{name} {shares[name]:.0%}" for name in ("bandwidth", "compute", "collectives"))
    yield "bound by", named
    launches = f"{numbers['kernels']:,}"
    if "launches" in shares:
        launches += f"; their launches take about {_seconds(numbers['kernels'] * LAUNCH_SECONDS)} beside it"
        if shares["launches"] > 1:
            launches += ", so they are what bounds it"
    yield "kernels", launches
    if numbers["collectives"]:
        each_kind = (
            f"{one['launches']} {kind}, {_bytes(one['bytes'])}" for kind, one in numbers["collectives"].items()
        )
        yield "collectives", "; ".join(each_kind) + " sent by a device"


def _bytes(value: float) -> str:
    return _scaled(value, "B")


def _scaled(value: float, unit: str) -> str:
    for size, prefix in ((1e15, "P"), (1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:.3g} {prefix}{unit}"
    return f"{value:.3g} {unit}"


def _seconds(value: float) -> str:
    if value < 1:
        return f"{value * 1e3:.3g} ms"
    return f"{value:.3g} s"


def memory_note(numbers: dict[str, Any], target: Target) -> list[str]:
    """Returns how to make jax use as much of a GPU's memory as a program needs, where that is more than by default."""
    if (
        target.card.platform == "cuda"
        and numbers["fits"]
        and numbers["memory_bytes"] > DEFAULT_SHARE * target.card.memory
    ):
        return [f"set XLA_PYTHON_CLIENT_MEM_FRACTION={GPU_SHARE}: by default jax takes {DEFAULT_SHARE:.0%} of a GPU"]
    return []
