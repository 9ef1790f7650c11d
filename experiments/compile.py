"""Compiles a preset's step for accelerators that are not here. ``python -m experiments.compile roboscape_s``"""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

from experiments.cli import main_errors, parse
from rsjax.files import write_file

PROG = "python -m experiments.compile"
# Without these, libtpu looks for a TPU, and jax for a GPU.
ABSENT = {
    "JAX_PLATFORMS": "cpu",
    "TPU_SKIP_MDS_QUERY": "1",
    "TPU_ACCELERATOR_TYPE": "v5litepod-4",
    "TPU_WORKER_HOSTNAMES": "localhost",
}


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    target: str = "h100"
    """The cluster: h100, h100x8."""
    dump: Path | None = None
    """Write the optimised program to this file."""


@main_errors()
def main() -> None:
    """Compiles, and prints the cost."""
    config, options = parse(sys.argv[1:], PROG, "Compiles for accelerators that are not here.", Options())
    os.environ |= ABSENT
    from rsjax.tools.compile import programs, targets
    from rsjax.tools.compile.roofline import part_of, roofline

    target = targets.find(options.target)
    compiled = programs.train(config, targets.devices(target)).compile()
    text = compiled.as_text()
    if options.dump:
        write_file(options.dump, text.encode())
    cost = roofline(text, target.card)
    from rsjax.models.base import create_model

    clips = config.train.batch_size
    flops = clips * create_model(config).flops(config.clips.frames).get("train", 0)
    memory = compiled.memory_analysis()
    for warning in cost.warnings:
        print(f"WARNING: {warning}")
    mfu = flops / (target.card.peak * target.devices * cost.seconds)
    moved = cost.bytes * target.devices / clips
    print(f"roofline {cost.seconds:.4f} s a step, model {flops / 1e12:.3f} TFLOP, roofline MFU {mfu:.2%}")
    print(f"{cost.flops * target.devices / 1e12:.3f} TFLOP executed, {moved / 1e9:.2f} GB a clip")
    print(f"{cost.launches} kernels, collectives {cost.collectives()}")
    print(f"temporaries {memory.temp_size_in_bytes / 1e9:.2f} GB, state {memory.argument_size_in_bytes / 1e9:.2f} GB")
    for kernel in sorted(cost.kernels, key=lambda kernel: -kernel.total)[:10]:
        work = f"{kernel.bytes / 1e6:9.1f} MB {kernel.flops / 1e9:8.1f} GFLOP"
        print(f"{kernel.total * 1e3:9.2f} ms {kernel.launches:5d} x {work} {kernel.name}  {kernel.op_name[-100:]}")
    for name, part in list(cost.by_part(part_of).items())[:20]:
        share = part.seconds / cost.seconds
        print(f"{share:7.1%} {part.bytes / 1e9:9.1f} GB {part.launches:6d} kernels  {name}")


if __name__ == "__main__":
    main()
