"""Times the first step of an environment in new processes: ``python -m benchmarks.first_step tiny``.

Each process starts with the compiled programs of those before it. The first finds none, so its figures are of compiling
everything; those of the others are of tracing the programs and of reading them. Times are of the processor, which says
more than a clock where others use the machine.
"""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from rsjax.tools.commands.cli import main_errors, parse_options

ROOT = Path(__file__).parents[1]
PHASES = ("imports", "make", "reset", "step", "second step")
PROGRAM = """
import json, sys, time
began = [time.process_time()]
import gymnasium
import rsjax.tools.policies.worlds.environments
began.append(time.process_time())
env = gymnasium.make("rsjax.tools.policies:rsjax/WorldModel-v0", run=sys.argv[1])
began.append(time.process_time())
env.reset(seed=0)
began.append(time.process_time())
for _ in range(2):
    env.step(env.action_space.sample())
    began.append(time.process_time())
print(json.dumps([after - before for before, after in zip(began, began[1:])]))
"""


@dataclass(frozen=True)
class Options:
    """Times the first step of an environment in new processes."""

    run: tyro.conf.Positional[str] = tyro.MISSING
    """A run directory, made by rsjax train; a saved model; or tiny or multitask, the package's models."""
    processes: int = 3
    """Processes, one after another."""
    source: Path = ROOT
    """The checkout to time."""


def first_step(run: str, source: Path, cache: Path) -> dict[str, float]:
    """Returns the processor time of each phase of a new process, in seconds.

    Args:
        run: the run, as for the environment.
        source: a checkout, whose code is timed.
        cache: the directory of compiled programs.
    """
    kept = {"JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1"}
    environment = os.environ | kept | {"PYTHONPATH": str(source.absolute())}
    line = [sys.executable, "-P", "-c", PROGRAM, run]
    done = subprocess.run(line, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return dict(zip(PHASES, json.loads(done.stdout.splitlines()[-1]), strict=True))


@main_errors()
def main() -> None:
    """Prints the times of each process."""
    options = parse_options(sys.argv[1:], "python -m benchmarks.first_step", Options.__doc__ or "", Options())
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.processes):
            times = first_step(options.run, options.source, Path(folder))
            both = times["reset"] + times["step"]
            print(f"process {number + 1}: {', '.join(f'{name} {x:.2f} s' for name, x in times.items())}")
            print(f"  reset and step together {both:.2f} s")


if __name__ == "__main__":
    main()
