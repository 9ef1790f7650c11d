import errno
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.files import FileError
from rsjax.training import checkpoint as module
from rsjax.training.checkpoint import Checkpoints


def state(step: int, size: int = 1000) -> dict[str, Any]:
    return {"w": jnp.asarray(np.random.default_rng(step).random(size, np.float32))}


def assert_newest(directory: Path, step: int, size: int = 1000) -> None:
    checkpoints = Checkpoints(directory)
    restored, data = checkpoints.restore(state(0, size))
    checkpoints.close()
    assert data == {"next": step}
    np.testing.assert_array_equal(restored["w"], state(step, size)["w"])


@pytest.fixture
def may_finish(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """No checkpoint is finished before this event is set."""
    event, finish = threading.Event(), module.write_checksums

    def wait_and_finish(*arguments: Any) -> None:
        assert event.wait(60)
        finish(*arguments)

    monkeypatch.setattr(module, "write_checksums", wait_and_finish)
    yield event
    event.set()


def test_training_continues_and_overwrites_the_state_while_it_is_written(
    tmp_path: Path, may_finish: threading.Event
) -> None:
    train = jax.jit(lambda state: jax.tree.map(lambda x: 3 * x + 1, state), donate_argnums=0)
    now = {"w": jnp.arange(2.0**20), "b": {"n": jnp.int32(5), "x": jnp.ones((3, 2**16))}}
    saved = jax.tree.map(lambda x: np.array(x, copy=True), now)
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, now, {})
    for _ in range(5):
        now = train(now)
    jax.block_until_ready(now)
    assert not (tmp_path / "1").exists()
    may_finish.set()
    checkpoints.wait()
    assert (tmp_path / "1").exists()
    restored, _ = checkpoints.restore(now)
    checkpoints.close()
    jax.tree.map(np.testing.assert_array_equal, restored, saved)


def test_host_arrays_may_change_while_they_are_written(tmp_path: Path, may_finish: threading.Event) -> None:
    now = {"w": np.arange(1000.0, dtype=np.float32)}
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, now, {})
    now["w"][:] = 0
    may_finish.set()
    restored, _ = checkpoints.restore(now)
    checkpoints.close()
    np.testing.assert_array_equal(restored["w"], np.arange(1000.0))


FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    ("error", "message", "then"),
    [
        (FULL, "the disk is full", "save"),
        (ValueError("UNAVAILABLE: no\nmore"), r"cannot write a checkpoint \(UNAVAILABLE: no\)$", "wait"),
        (FULL, "the disk is full", "close"),
    ],
)
def test_a_failure_in_the_background_is_reported_by_the_next_call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, message: str, then: str
) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state(1), {"next": 1})
    checkpoints.wait()
    with monkeypatch.context() as patch:

        def fail(*_: Any) -> None:
            raise error

        patch.setattr(module, "write_checksums", fail)
        checkpoints.save(2, state(2), {"next": 2})
        with pytest.raises(FileError, match=f"{tmp_path}: {message}"):
            checkpoints.save(3, state(3), {}) if then == "save" else getattr(checkpoints, then)()
    assert [path.name for path in tmp_path.iterdir()] == ["1"]
    if then != "close":
        checkpoints.save(2, state(2), {"next": 2})
        checkpoints.close()
    assert_newest(tmp_path, 1 if then == "close" else 2)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 2 MiB."""
    path = tmp_path / "disk"
    path.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", path], capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip("a small file system can be mounted by root only")
    yield path
    subprocess.run(["umount", "-l", path], check=True)


@pytest.mark.parametrize("spare", [8, 450])
def test_a_disk_that_fills_up_keeps_the_last_checkpoint(
    small_disk: Path, monkeypatch: pytest.MonkeyPatch, spare: int
) -> None:
    size = 2**17  # 512 KiB, which do not compress
    usage = module.shutil.disk_usage(small_disk)
    monkeypatch.setattr(module.shutil, "disk_usage", lambda path: usage)  # another process takes the space meanwhile
    checkpoints = Checkpoints(small_disk / "checkpoints")
    checkpoints.save(1, state(1, size), {"next": 1})
    checkpoints.wait()
    filler = small_disk / "filler"
    free = 2**21 - sum(path.stat().st_blocks * 512 for path in small_disk.rglob("*"))
    filler.write_bytes(b"x" * (free - spare * 1024))
    with pytest.raises(FileError, match="checkpoints: the disk is full"):  # noqa: PT012 - either may report it
        checkpoints.save(2, state(2, size), {"next": 2})
        checkpoints.wait()
    assert [path.name for path in (small_disk / "checkpoints").iterdir()] == ["1"]
    assert_newest(small_disk / "checkpoints", 1, size)
    filler.unlink()
    checkpoints.save(2, state(2, size), {"next": 2})
    checkpoints.close()
    assert_newest(small_disk / "checkpoints", 2, size)
