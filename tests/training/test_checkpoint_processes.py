import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from rsjax.training.checkpoint import Checkpoints


@pytest.fixture
def port() -> int:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return int(free.getsockname()[1])


def test_two_processes_save_together_and_one_reads_it(tmp_path: Path, port: int) -> None:
    directory = tmp_path / "checkpoints"
    command = [sys.executable, "-m", "tests.training.checkpoint_processes"]
    processes = [
        subprocess.Popen(
            [*command, me, str(port), str(directory)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for me in ("0", "1")
    ]
    said = [process.communicate(timeout=100) for process in processes]
    for (out, err), process in zip(said, processes, strict=True):
        assert process.returncode == 0, err
        assert out.endswith("done\n")
    assert "checkpoint 3 is damaged (data/metadata: No such file or directory)" in said[0][0]
    assert "damaged" not in said[1][0]

    rng = np.random.default_rng(4)
    saved = {"cut": rng.random((8, 16), np.float32), "whole": rng.random(5, np.float32), "step": np.int32(4)}
    checkpoints = Checkpoints(directory)
    restored, data = checkpoints.restore(jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), saved))
    checkpoints.close()
    assert data == {"next": 4}
    jax.tree.map(np.testing.assert_array_equal, restored, saved)
