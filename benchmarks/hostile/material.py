"""Makes the material of the cases: a run of ``debug`` with a policy, a judge, demonstrations and a saved model.

``python -m benchmarks.hostile.material FOLDER``; in a minute or two.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from rsjax.errors import UserError

WHOLE = "whole"  # a file that is written last


def make(folder: Path) -> None:
    """Makes the material unless it is there.

    Raises:
        UserError: a command that makes a part of it failed.
    """
    if (folder / WHOLE).exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    run = ("--data-dir", str(folder / "data"))
    _rsjax("train", "debug", "--run-dir", str(folder / "run"), *run)
    subprocess.run([sys.executable, "-m", "benchmarks.hostile.material", str(folder)], check=True)
    _rsjax("synthesize", str(folder / "run"), *run, "--demos", "2", "--only", "all", "--out", str(folder / "synthetic"))
    _rsjax("save", str(folder / "run"), str(folder / "saved"), *run, "--measured", "0", "--clips", "2")
    store = next((folder / "data").glob("lift-*"))
    for name in ("store", "other"):
        shutil.copytree(store, folder / name, ignore=shutil.ignore_patterns("tokens"))
    (folder / "file").write_text("something\n")
    (folder / "empty").mkdir()
    os.mkfifo(folder / "fifo")
    (folder / WHOLE).touch()


def _rsjax(*words: str) -> None:
    done = subprocess.run([sys.executable, "-m", f"experiments.{words[0]}", *words[1:]], capture_output=True, text=True)
    if done.returncode:
        raise UserError(f"rsjax {' '.join(words)} failed: {done.stderr[-500:]}")


def make_small(folder: Path) -> None:
    """Makes a policy and a judge of a few training steps; the judge's labels are invented."""
    import numpy as np

    from rsjax.tools.policies.judges.judge_training import FOLDER
    from rsjax.tools.policies.judges.trained_judge import Footage, train_judge
    from rsjax.tools.policies.policy_training import train_policy
    from rsjax.tools.policies.run_data import RunData, sized_policy

    data = RunData(folder / "run", folder / "data")
    train_policy(sized_policy("toy", 4), data.demos(only="all"), folder / "policy", stops=(2,))
    source = data.clips.source("train")
    rgb = np.stack([source[number]["rgb"] for number in range(4)])
    success = np.zeros(rgb.shape[:2], bool)
    success[:2, -2:] = True
    footage = Footage(rgb, success)
    train_judge(footage, footage, 4).save(data.run / FOLDER)


if __name__ == "__main__":
    make_small(Path(sys.argv[1]))
