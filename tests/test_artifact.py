import json
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.artifact import MARK, OtherKeyError, is_finished, make_once, read_mark
from rsjax.files import FileError, lock_file, write_file

STEPS = 5
REFUSE = "holds steps of other settings; choose another --out"

COUNT = """
    import os, signal, sys, time
    from pathlib import Path
    from rsjax.artifact import make_once

    folder, key, killed_at, log = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), Path(sys.argv[4])
    with make_once(folder, key, refuse=None, wait=True) as work:
        if not work.finished:
            for number in range(work.metadata.get("steps", 0), 5):
                if number == killed_at:
                    os.kill(os.getpid(), signal.SIGKILL)
                with log.open("a") as file:
                    file.write(f"{number} ")
                time.sleep(0.02)
                work.save(steps=number + 1)
"""


def fail_after(file: Path) -> None:
    file.touch()
    raise InterruptedError


def start(folder: Path, key: str, killed_at: int, log: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", textwrap.dedent(COUNT), str(folder), key, str(killed_at), str(log)]
    return subprocess.Popen(command)


@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, STEPS)), max_size=8), st.booleans())
def test_work_continues_under_its_key_and_never_under_another(
    tmp_path_factory: pytest.TempPathFactory, attempts: list[tuple[str, int]], refused: bool
) -> None:
    folder = tmp_path_factory.mktemp("work") / "folder"
    refuse = REFUSE if refused else None
    owner, done = "", 0  # what the folder should hold
    for key, last in attempts:
        if refused and owner not in ("", key):
            with pytest.raises(OtherKeyError, match=REFUSE), make_once(folder, key, refuse=refuse):
                raise AssertionError("the body of refused work must not run")
            continue
        if owner != key:
            owner, done = key, 0
        try:
            with make_once(folder, key, refuse=refuse) as work:
                assert work.finished == (done == STEPS)
                assert work.metadata.get("steps", 0) == done == len(list(folder.glob("*.step")))
                if not work.finished:
                    for number in range(done, STEPS):
                        if number >= last:
                            raise InterruptedError
                        write_file(folder / f"{number}.step", b"")
                        work.save(steps=number + 1)
                        done = number + 1
        except InterruptedError:
            pass
        assert is_finished(folder, key) == (done == STEPS)
        assert not is_finished(folder, "other")


def test_a_killed_process_leaves_half_done_work_to_the_next(tmp_path: Path) -> None:
    folder, log = tmp_path / "folder", tmp_path / "log"
    assert start(folder, "key", 2, log).wait() != 0
    mark = read_mark(folder)
    assert mark is not None
    assert (mark.key, mark.finished, mark.metadata) == ("key", False, {"steps": 2})
    assert start(folder, "key", STEPS, log).wait() == 0
    assert is_finished(folder, "key")
    assert log.read_text().split() == ["0", "1", "2", "3", "4"], "no step was made twice"
    assert start(folder, "other", STEPS, log).wait() == 0
    assert is_finished(folder, "other")
    assert len(log.read_text().split()) == 2 * STEPS


def test_of_two_processes_one_makes_it_and_the_other_waits(tmp_path: Path) -> None:
    folder, log = tmp_path / "folder", tmp_path / "log"
    both = [start(folder, "key", STEPS, log) for _ in range(2)]
    assert [process.wait() for process in both] == [0, 0]
    assert log.read_text().split() == ["0", "1", "2", "3", "4"]


def test_who_does_not_wait_is_told_who_works_there(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    second = make_once(folder, "key", refuse=REFUSE)
    with make_once(folder, "key", refuse=REFUSE), pytest.raises(FileError, match="is making it; wait"), second:
        raise AssertionError("two work in one folder")
    assert lock_file(folder).exists()


def test_seconds_add_up_and_finished_work_can_be_done_again(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    with pytest.raises(InterruptedError), make_once(folder, "key", refuse=REFUSE):
        raise InterruptedError
    (folder / MARK).write_text(json.dumps(json.loads((folder / MARK).read_text()) | {"seconds": 100.0}))
    with make_once(folder, "key", refuse=REFUSE):
        pass
    mark = read_mark(folder)
    assert mark is not None
    assert mark.seconds >= 100.0
    with make_once(folder, "key", refuse=REFUSE) as work:
        assert work.finished
    with make_once(folder, "key", refuse=REFUSE, again=True) as work:
        assert not work.finished
        assert not is_finished(folder, "key")
    assert is_finished(folder, "key")


def test_a_temporary_folder_goes_when_its_work_ends_and_stays_when_it_fails(tmp_path: Path) -> None:
    folder = tmp_path / "out.partial"
    first = make_once(folder, "key", refuse=None, temporary=True)
    with pytest.raises(InterruptedError), first as work:
        fail_after(work.folder / "clip")
    assert (folder / "clip").exists()
    with make_once(folder, "key", refuse=None, temporary=True):
        assert (folder / "clip").exists()
    assert not folder.exists()


@pytest.mark.parametrize("damage", [b"", b"[]", b'{"key": 1}', b'{"key": "key", "finished": true, "seconds": NaN}'])
def test_a_damaged_mark_never_counts_as_finished(tmp_path: Path, damage: bytes) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / MARK).write_bytes(damage)
    (folder / "old").touch()
    assert not is_finished(folder, "key")
    with pytest.raises(OtherKeyError), make_once(folder, "key", refuse=REFUSE):
        raise AssertionError("work of an unknown key was taken over")
    with make_once(folder, "key", refuse=None) as work:
        assert not work.finished
        assert not (folder / "old").exists()


def test_files_without_a_mark_are_never_deleted(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "old").touch()
    with pytest.raises(FileError) as caught, make_once(folder, "key", refuse=None):
        raise AssertionError("the body must not run")
    assert "holds files of something else" in str(caught.value)
    with make_once(folder, "key", refuse=REFUSE):
        assert (folder / "old").exists()
