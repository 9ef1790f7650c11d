"""Compiles a preset for absent accelerators. ``rsjax compile roboscape_s --target h100x8``"""

import os
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from rsjax.errors import UserError
from rsjax.files import write_file, write_json
from rsjax.runtime import set_xla_flags
from rsjax.tools.commands.cli import main_errors, parse
from rsjax.tools.compile import targets

PROG = "rsjax compile"
PACKAGES = {"cuda": ("jax_cuda13_plugin", "CUDA packages of jax"), "tpu": ("libtpu", "libtpu")}


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    target: str = "h100"
    """The cluster, such as h100, a100x8, rtx4090, v5e-16, v5p-64 (docs/compile.md lists all)."""
    part: Literal["train", "sample", "tokenizer"] = "train"
    """The training step, a generated frame, or the tokenizer's training step and its encoding."""
    clips: int = 64
    """With --part sample: clips that are generated at once, beside one alone."""
    largest: bool = True
    """Compile a second batch size, to extrapolate the largest batch that fits."""
    json: Path | None = None
    """Write the numbers to this file."""
    dump: Path | None = None
    """Write the optimised program to this file."""


@main_errors()
def main() -> None:
    """Compiles, and prints memory, cost and speed."""
    about = "Compiles for accelerators that are not here, and says what they could do at most. PRESET may be a run."
    config, options = parse(sys.argv[1:], PROG, about, Options(), runs=True)
    target = targets.find(options.target)
    set_xla_flags()  # as training does
    enter_environment(target.card.platform)
    from rich.console import Console

    from rsjax.tools.compile.report import render
    from rsjax.tools.compile.run import check, run

    texts: list[str] = []
    console = Console()
    results = run(config, target, options.part, options.clips, Console(stderr=True), options.largest, keep=texts.append)
    for numbers in results:
        console.print(render(numbers, target, config.name), "")
    if options.dump:
        write_file(options.dump, "\n".join(texts).encode())
    if options.json:
        write_json(options.json, {"preset": config.name, "part": options.part} | results[0] | {"others": results[1:]})
    check(results, config, options.part, target)


def enter_environment(platform: str, prefix: str = sys.prefix) -> None:
    """Continues in the environment with the compilers, where they are not in this one.

    Args:
        prefix: the directory of this environment.

    Raises:
        UserError: there is no such environment, or it lacks the compiler.
    """
    package, title = PACKAGES[platform]
    python = Path(prefix) / "accelerators" / "bin" / "python"
    if not find_spec(package) and (not python.exists() or "accelerators" in Path(prefix).name):
        raise UserError(f"the compiler is not installed ({title}); make accelerators installs it, 5 GB in all")
    os.environ |= targets.ENVIRONMENT
    if not find_spec(package):
        os.execve(python, [str(python), *sys.orig_argv[1:]], os.environ)
