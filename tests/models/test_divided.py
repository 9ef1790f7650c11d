import json
import subprocess
import sys

from tests.training.test_sharding import ROOT, virtual


def test_devices_divide_the_clips_of_a_batch() -> None:
    """The devices must exist before jax starts, hence a process of its own."""
    command = [sys.executable, "-m", "tests.models.divided"]
    done = subprocess.run(command, cwd=ROOT, env=virtual(2), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    in_rows = json.loads(done.stdout.splitlines()[-1])
    assert {name.removeprefix("rsjax.models."): rows for name, rows in in_rows.items()} == {
        "ivideogpt.rollout.sample": [True],
        "ivideogpt.autoencoder._apply": [True] * 2,
        "roboscape.teacher_forcing._score_window": [True] * 2,
    }
