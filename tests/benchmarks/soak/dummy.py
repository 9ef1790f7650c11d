"""Leaves what a training command leaves in its directory, without training: ``python dummy.py FOLDER [FAULT]``.

FAULT is ``deaf`` (exits with 1 on SIGTERM) or ``broken`` (cannot be started twice).
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

STEPS, EVERY, SECONDS = 60, 6, 0.01


def write(path: Path, text: str) -> None:
    temporary = path.with_name(f"{path.name}.tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def main(folder: Path, fault: str) -> None:
    stopped = []
    signal.signal(signal.SIGTERM, lambda *_: stopped.append(1))
    saved = folder / "checkpoints"
    if fault == "broken" and saved.exists():
        sys.exit("cannot go on")
    saved.mkdir(parents=True, exist_ok=True)
    write(folder / "made.json", json.dumps({"finished": False}))
    time.sleep(0.05)
    first = max((int(path.name) for path in saved.iterdir() if path.name.isdigit()), default=0)
    log = folder / "log.jsonl"
    lines = log.read_text().splitlines(keepends=True) if log.exists() else []
    write(log, "".join(lines[:first]))
    for step in range(first + 1, STEPS + 1):
        time.sleep(SECONDS)
        with log.open("a") as file:
            file.write(json.dumps({"step": step, "loss": 1 / step, "seconds_per_step": SECONDS}) + "\n")
        if step % EVERY == 0 or stopped:
            half = saved / f"{step}.orbax-checkpoint-tmp"
            half.mkdir(exist_ok=True)
            time.sleep(0.02)
            half.rename(saved / str(step))
        if stopped:
            sys.exit(1 if fault == "deaf" else os.EX_TEMPFAIL)
    write(folder / "made.json", json.dumps({"finished": True}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "")
