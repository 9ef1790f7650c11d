import contextlib
import io
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.training import checkpoint as checksums
from rsjax.training.checkpoint import CheckpointError, Checkpoints, find_fault

STEPS = (1, 2)


def state(step: int) -> dict[str, Any]:
    return {"w": step * jnp.arange(1.0, 1001.0), "inner": {"b": jnp.int32(step)}}


def truncate(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


def flip(path: Path, share: float) -> None:
    content = bytearray(path.read_bytes())
    content[int(share * len(content))] ^= 1 << int(share * 1000) % 8
    path.write_bytes(content)


def delete(path: Path, share: float) -> None:
    path.unlink()


WAYS: tuple[Callable[[Path, float], None], ...] = (truncate, flip, delete)


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("checkpoints")
    checkpoints = Checkpoints(directory)
    for step in STEPS:
        checkpoints.save(step, state(step), {"next": step})
    checkpoints.close()
    return directory


@pytest.fixture
def copy(intact: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(intact, tmp_path / "copy"))


def files(checkpoint: Path) -> list[Path]:
    return sorted(path for path in checkpoint.rglob("*") if path.is_file() and path.stat().st_size)


def restored(directory: Path) -> tuple[int, str]:
    """Restores the newest step, which has to be as it was saved. Returns it and the output."""
    checkpoints, output = Checkpoints(directory), io.StringIO()
    with contextlib.redirect_stdout(output):
        got, data = checkpoints.restore(state(0))
    checkpoints.close()
    jax.tree.map(np.testing.assert_array_equal, got, state(data["next"]))
    return data["next"], output.getvalue()


@given(which=st.floats(0, 0.999), way=st.sampled_from(WAYS), share=st.floats(0, 0.999))
@settings(max_examples=10, deadline=None)
def test_damage_is_harmless_or_the_older_checkpoint_is_used(
    intact: Path, which: float, way: Callable[[Path, float], None], share: float
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(shutil.copytree(intact, Path(folder) / "copy"))
        damaged = files(directory / "2")[int(which * len(files(directory / "2")))]
        way(damaged, share)
        step, output = restored(directory)
        if step == 2:
            # Orbax's notes at the top are not read; a bit of the checksums' JSON may not matter.
            assert damaged.parent == directory / "2"
            assert output == ""
        else:
            assert step == 1
            assert f"checkpoint 2 is damaged ({damaged.relative_to(directory / '2')}: " in output
            assert f"resuming from that of step 1; kept as {directory}/bad-2" in output
            assert output.count("\n") == 1


def test_damage_of_any_file_in_a_folder_is_detected(intact: Path, copy: Path) -> None:
    inner = [path for path in files(intact / "2") if path.parent != intact / "2"]
    assert len(inner) > 5
    assert find_fault(copy / "2") is None
    for path in inner:
        for way in WAYS:
            for share in (0.0, 0.5, 0.999):
                target = copy / path.relative_to(intact)
                way(target, share)
                assert str(path.relative_to(intact / "2")) in str(find_fault(copy / "2"))
                shutil.copy(path, target)


def test_every_flipped_bit_of_the_checksums_is_detected_or_harmless(copy: Path) -> None:
    path = copy / "2" / checksums.CHECKSUMS
    intact, content = path.read_bytes(), json.loads(path.read_text())
    for bit in range(0, 8 * len(intact), 31):
        damaged = bytearray(intact)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        if find_fault(copy / "2") is None:
            assert json.loads(path.read_text()) == content


def test_after_a_fall_back_the_same_step_can_be_saved_again(copy: Path) -> None:
    delete(copy / "2" / "data" / "metadata", 0)
    (copy / "bad-2").mkdir()  # of an earlier resume
    checkpoints = Checkpoints(copy)
    assert checkpoints.restore(state(0))[1] == {"next": 1}
    assert checkpoints.steps() == [1]
    checkpoints.save(2, state(2), {"next": 2})
    checkpoints.close()
    assert restored(copy)[0] == 2
    assert find_fault(copy / "bad-2") == "data/metadata: No such file or directory"


def test_if_all_are_damaged_it_stops_each_time_and_moves_nothing(copy: Path) -> None:
    for step in STEPS:
        truncate(copy / str(step) / "data" / "metadata", 0.5)
    for _ in range(2):
        checkpoints = Checkpoints(copy)
        fault = "data/metadata: not what was written"
        with pytest.raises(
            CheckpointError, match=rf"{copy}: no checkpoint .*\(2: {fault}; 1: {fault}\); .*--no-resume"
        ):
            checkpoints.restore(state(0))
        checkpoints.close()
    assert sorted(path.name for path in copy.iterdir()) == ["1", "2"]


def test_without_a_checkpoint_restore_fails(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    with pytest.raises(CheckpointError, match=rf"{tmp_path}: no checkpoint can be read \(there is none\)"):
        checkpoints.restore(state(0))
    checkpoints.close()


def test_another_architecture_is_not_damage(copy: Path) -> None:
    checkpoints = Checkpoints(copy)
    for other in (state(0) | {"w": jnp.zeros(3)}, {"w": jnp.zeros(1000)}, state(0) | {"more": jnp.zeros(1)}):
        with pytest.raises(CheckpointError, match=rf"{copy}/2: does not fit this configuration .*, the configuration"):
            checkpoints.restore(other)
    checkpoints.close()
    assert restored(copy) == (2, "")


def test_a_damaged_checkpoint_before_another_architecture_stays_where_it_is(copy: Path) -> None:
    delete(copy / "2" / checksums.CHECKSUMS, 0)
    checkpoints = Checkpoints(copy)
    with pytest.raises(CheckpointError, match=rf"{copy}/1: does not fit this configuration"):
        checkpoints.restore({"w": jnp.zeros(3)})
    checkpoints.close()
    assert sorted(path.name for path in copy.iterdir()) == ["1", "2"]
