import subprocess
from pathlib import Path

import pytest

from benchmarks.soak.disk import can_mount, small_disk, unmount_below


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    if not can_mount(tmp_path):
        pytest.skip("mounting a small disk needs root and Linux")
    (tmp_path / "folder" / "deep").mkdir(parents=True)
    (tmp_path / "folder" / "deep" / "old").write_bytes(b"x" * 100_000)
    return tmp_path / "folder"


def test_a_small_disk_is_full_soon_and_what_was_added_stays(folder: Path) -> None:
    with small_disk(folder, 50_000):
        assert folder.is_mount()
        (folder / "new").write_bytes(b"y" * 40_000)
        with pytest.raises(OSError, match="No space left on device"):
            (folder / "more").write_bytes(b"z" * 40_000)
        (folder / "more").unlink()
    assert not folder.is_mount()
    assert {path.name: path.stat().st_size for path in folder.rglob("*") if path.is_file()} == {
        "old": 100_000,
        "new": 40_000,
    }
    assert [path.name for path in folder.parent.iterdir()] == ["folder"]


def test_a_mount_that_was_left_behind_is_found(folder: Path) -> None:
    subprocess.run(["mount", "-t", "tmpfs", "tmpfs", str(folder)], check=True)
    assert folder.is_mount()
    unmount_below(folder.parent)
    assert not folder.is_mount()
    assert (folder / "deep" / "old").exists()
