"""Really full disks: puts a directory on a small file system of its own. Needs root and Linux's tmpfs."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

UNLIMITED = 2**40  # bytes; memory is taken only as files fill it


def can_mount(directory: Path) -> bool:
    """Whether a file system can be mounted in this directory."""
    probe = directory / "probe"
    probe.mkdir(parents=True, exist_ok=True)
    try:
        _mount(probe, 2**20)
        _run("umount", "-l", str(probe))
    except (OSError, subprocess.CalledProcessError):
        return False
    finally:
        probe.rmdir()
    return True


@contextmanager
def small_disk(folder: Path, spare: int) -> Iterator[None]:
    """Puts the directory on a disk of its own with ``spare`` bytes left; at the end, moves it back with what was added.

    Nobody may read or write in it when it moves, in either direction.
    """
    aside, back = (folder.with_name(f"{folder.name}.{word}") for word in ("aside", "back"))
    folder.rename(aside)
    folder.mkdir()
    _mount(folder, UNLIMITED)
    kept = aside
    try:
        shutil.copytree(aside, folder, dirs_exist_ok=True)
        disk = os.statvfs(folder)
        used = (disk.f_blocks - disk.f_bfree) * disk.f_frsize
        _run("mount", "-o", f"remount,size={used + spare}", str(folder))
        yield
        shutil.copytree(folder, back)
        kept = back
    finally:
        _run("umount", "-l", str(folder))
        folder.rmdir()
        kept.rename(folder)
        for other in (aside, back):
            shutil.rmtree(other, ignore_errors=True)


def unmount_below(directory: Path) -> None:
    """Unmounts what a killed soak left mounted in this directory."""
    try:
        lines = Path("/proc/self/mountinfo").read_text().splitlines()
    except OSError:
        return  # not Linux, so nothing was ever mounted
    for line in reversed(lines):
        mounted = Path(line.split()[4].replace("\\040", " "))
        if directory.absolute() in mounted.parents:
            _run("umount", "-l", str(mounted))


def _mount(folder: Path, size: int) -> None:
    _run("mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder))


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)
