"""Full disks for real: a directory put on a small file system of its own. Needs root and Linux's tmpfs."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

TOO_MUCH = 2**40  # bytes; memory is taken only as files fill it


def can_mount(place: Path) -> bool:
    """Whether a file system can be mounted in this directory."""
    probe = place / "probe"
    probe.mkdir(parents=True, exist_ok=True)
    try:
        _mount(probe, 2**20)
        _unmount(probe)
    except (OSError, subprocess.CalledProcessError):
        return False
    finally:
        probe.rmdir()
    return True


@contextmanager
def small_disk(folder: Path, spare: int) -> Iterator[None]:
    """The directory on a disk of its own with ``spare`` bytes left; afterwards where it was, with what was added.

    Whoever reads or writes there must have ended before, on both sides.
    """
    aside, back = (folder.with_name(f"{folder.name}.{word}") for word in ("aside", "back"))
    folder.rename(aside)
    folder.mkdir()
    _mount(folder, TOO_MUCH)
    stays = aside
    try:
        shutil.copytree(aside, folder, dirs_exist_ok=True)
        disk = os.statvfs(folder)
        used = (disk.f_blocks - disk.f_bfree) * disk.f_frsize
        _run("mount", "-o", f"remount,size={used + spare}", str(folder))
        yield
        shutil.copytree(folder, back)
        stays = back
    finally:
        _unmount(folder)
        folder.rmdir()
        stays.rename(folder)
        for other in (aside, back):
            shutil.rmtree(other, ignore_errors=True)


def unmount_below(place: Path) -> None:
    """Unmounts what a killed soak left mounted in this directory."""
    try:
        lines = Path("/proc/self/mountinfo").read_text().splitlines()
    except OSError:
        return  # not Linux, so nothing was ever mounted
    for line in reversed(lines):
        mounted = Path(line.split()[4].replace("\\040", " "))
        if place.absolute() in mounted.parents:
            _unmount(mounted)


def _mount(folder: Path, size: int) -> None:
    _run("mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder))


def _unmount(folder: Path) -> None:
    _run("umount", "-l", str(folder))


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)
