import gc
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.config import LoopConfig
from rsjax.files import FileError
from rsjax.training import checkpoint as module
from rsjax.training.checkpoint import CheckpointError, Checkpoints, load_weights, save_weights
from rsjax.training.state import create_state
from tests.training.toy import Regression, train

LOOP = LoopConfig(steps=2, batch_size=2, log_every=1, checkpoint_every=1, sharding="jit")

# When one read fails, orbax leaves others running; their errors are raised when they are garbage-collected.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.fixture(autouse=True)
def collected() -> Iterator[None]:
    yield
    gc.collect()


@pytest.fixture(scope="module")
def trained_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("trained")
    train(LOOP, directory)
    return directory


@pytest.fixture
def trained(trained_once: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained_once, tmp_path / "trained"))


def truncate_largest(directory: Path) -> None:
    largest = max((p for p in directory.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    largest.write_bytes(largest.read_bytes()[: largest.stat().st_size // 2])


def test_a_whole_state_is_restored(tmp_path: Path) -> None:
    state = create_state(Regression(), replace(LOOP, ema=0.5)).replace(step=jax.numpy.int32(7))  # type: ignore[attr-defined]
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.latest() is None
    checkpoints.save(7, state, {"next": [1, 2]})
    checkpoints.close()
    again = Checkpoints(tmp_path)
    restored, data = again.restore(create_state(Regression(), replace(LOOP, ema=0.5, seed=1)))
    again.close()
    jax.tree.map(np.testing.assert_array_equal, restored, state)
    assert data == {"next": [1, 2]}


@pytest.mark.parametrize("change", [{"model": Regression(2)}, {"ema": 0.9}], ids=["shape", "structure"])
def test_a_checkpoint_of_another_architecture_is_named(trained: Path, change: dict[str, Any]) -> None:
    model = change.pop("model", Regression())
    with pytest.raises(CheckpointError, match=rf"{trained}/checkpoints/2: does not fit.*run directory") as raised:
        train(replace(LOOP, **change), trained, model=model)
    assert "\n" not in str(raised.value)


def test_training_resumes_from_the_checkpoint_before_a_damaged_one(
    trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = train(LOOP, trained)
    truncate_largest(trained / "checkpoints" / "2" / "state")
    jax.tree.map(np.testing.assert_array_equal, train(LOOP, trained), whole)
    assert "checkpoint 2 is damaged" in capsys.readouterr().out
    assert {path.name for path in (trained / "checkpoints").iterdir()} == {"1", "2", "bad-2"}


def test_a_full_disk_is_reported_and_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = create_state(Regression(), LOOP)
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    usage = module.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(module.shutil, "disk_usage", lambda path: usage._replace(free=10))
    for name, save in (
        ("checkpoints", lambda: checkpoints.save(1, state, {})),
        ("weights", lambda: save_weights(tmp_path / "weights", state.params)),
    ):
        with pytest.raises(FileError, match=f"{tmp_path / name}: the disk is full"):
            save()
    checkpoints.close()
    assert [path for path in tmp_path.rglob("*") if path.name != "checkpoints"] == []
    monkeypatch.setattr(module.shutil, "disk_usage", lambda path: usage._replace(free=30))
    save_weights(tmp_path / "weights", {"w": np.zeros(4, np.float32)})


def test_weights_alone_are_restored_and_may_be_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "weights"
    for seed in (1, 2):
        weights = Regression().init(jax.random.key(seed))
        save_weights(path, weights)
        like = jax.eval_shape(Regression().init, jax.random.key(0))
        jax.tree.map(np.testing.assert_array_equal, load_weights(path, like), weights)


def test_weights_stay_until_those_that_replace_them_are_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old, new = (Regression().init(jax.random.key(seed)) for seed in (1, 2))
    save_weights(tmp_path / "weights", old)
    save = module.ocp.StandardCheckpointer.save

    def interrupted(self: Any, *arguments: Any, **options: Any) -> None:
        save(self, *arguments, **options)
        self.wait_until_finished()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module.ocp.StandardCheckpointer, "save", interrupted)
        with pytest.raises(KeyboardInterrupt):
            save_weights(tmp_path / "weights", new)
    jax.tree.map(np.testing.assert_array_equal, load_weights(tmp_path / "weights", old), old)
    save_weights(tmp_path / "weights", new)
    jax.tree.map(np.testing.assert_array_equal, load_weights(tmp_path / "weights", old), new)
    assert [path.name for path in tmp_path.iterdir()] == ["weights"]


def test_a_flipped_bit_in_weights_is_refused_wherever_it_is(tmp_path: Path) -> None:
    path = tmp_path / "weights"
    weights = Regression().init(jax.random.key(0))
    save_weights(path, weights)
    rng = np.random.default_rng(0)
    files = sorted(file for file in path.rglob("*") if file.is_file())
    assert any(file.name == module.CHECKSUMS for file in files)
    for file in files:
        content = file.read_bytes()
        for place in rng.integers(0, 8 * len(content), 3 if content else 0).tolist():
            flipped = bytearray(content)
            flipped[place // 8] ^= 1 << place % 8
            file.write_bytes(bytes(flipped))
            with pytest.raises(CheckpointError) as raised:
                load_weights(path, weights)
            assert str(raised.value).startswith(f"{path}: is damaged (")
        file.unlink()
        os.mkfifo(file)  # which nobody writes to
        with pytest.raises(CheckpointError) as raised:
            load_weights(path, weights)
        assert "a pipe or device" in str(raised.value)
        file.unlink()
        file.write_bytes(content)
    load_weights(path, weights)
    (path / module.CHECKSUMS).unlink()
    with pytest.raises(CheckpointError) as raised:
        load_weights(path, weights)
    assert str(raised.value).startswith(f"{path}: is damaged (")


def test_weights_that_are_missing_other_or_damaged_are_named(tmp_path: Path) -> None:
    path, like = tmp_path / "weights", Regression().init(jax.random.key(0))

    def put_pointers() -> None:
        for file in filter(Path.is_file, path.rglob("*")):
            file.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n")

    others = (Regression(2).init(jax.random.key(0)), like | {"more": like["b"]}, {"w": like["w"]})
    cases: tuple[tuple[Callable[[], object], Any, str], ...] = (
        (lambda: None, like, ": no such weights; train first"),
        *((lambda: save_weights(path, like), other, ": does not fit") for other in others),
        (lambda: truncate_largest(path), like, ": .*damaged"),
        (put_pointers, like, "/.*: a Git-LFS pointer .* git lfs pull"),
    )
    for prepare, wanted, message in cases:
        prepare()
        with pytest.raises(CheckpointError, match=f"{path}{message}"):
            load_weights(path, wanted)
