import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import rsjax
from rsjax.config import presets
from rsjax.data.labels import Labels
from rsjax.data.normalization import FILE, Normalization
from rsjax.data.quarantine import read_quarantine
from rsjax.data.store import open_store
from rsjax.errors import UserError
from rsjax.files import (
    FileError,
    check_place,
    checked_path,
    content_hash,
    holder,
    is_held,
    lock,
    making,
    placeholder,
    read_json,
)
from rsjax.tokenizers.lpips import load_lpips
from rsjax.tools.convert.files import read_tensors
from rsjax.tools.ingest.annotators.network import require_weights
from rsjax.tools.ingest.doctor import select
from rsjax.tools.pipeline.videos import VideoRequest, _foreign_actions
from rsjax.tools.policies.judges.people_and_vlms import HumanJudge
from rsjax.training.log import read_rows
from tests.tools.ingest.toy import Source


def test_an_error_can_be_printed_whatever_the_name_of_a_file() -> None:
    with pytest.raises(UserError) as error:
        rsjax.load("\udc80")
    assert "\\udc80" in str(error.value) and str(error.value).isprintable()


def test_a_hash_of_content_is_the_files_wherever_they_lie(tmp_path: Path) -> None:
    for place in ("a", "b"):
        (tmp_path / place / "sub").mkdir(parents=True)
        (tmp_path / place / "sub" / "x.py").write_bytes(b"1")
    a, b = tmp_path / "a", tmp_path / "b"
    (b / ".git").mkdir()
    (b / ".git" / "x").touch()
    whole = content_hash(a)
    assert whole == content_hash(b) != content_hash(a / "sub")
    assert content_hash(a / "sub" / "x.py") == "6b86b273ff34fce1", "SHA-256 of 1"
    (b / "sub" / "y").touch()
    assert content_hash(b) != whole == content_hash(b, "*.py")
    with pytest.raises(FileError, match="none: cannot be read"):
        content_hash(tmp_path / "none")


@pytest.mark.parametrize(
    ("payload", "message"),
    [
        (b'{"x": 1}', None),
        (b"{", r"not JSON"),
        (b"\xff\xfe\x00", r"not JSON"),
        (b"[" * 100_000, r"not JSON"),
        (b"[1, 2]", r"a JSON dict is expected, not \[1, 2\]"),
        (None, r"missing"),
        ("a directory", r"cannot be read \(Is a directory\)"),
        ("a loop", r"cannot be read \(Too many levels of symbolic links\)"),
    ],
)
def test_a_json_file_is_read_or_named_in_one_line(
    tmp_path: Path, payload: bytes | str | None, message: str | None
) -> None:
    path = tmp_path / "file.json"
    if payload == "a directory":
        path.mkdir()
    elif payload == "a loop":
        path.symlink_to(path)
    elif isinstance(payload, bytes):
        path.write_bytes(payload)
    if message is None:
        assert read_json(path) == {"x": 1}
        return
    with pytest.raises(UserError, match=f"{path}: {message}.*; (make it again|mend)"):
        read_json(path, cure="make it again")


def test_a_pipe_is_refused_at_once_in_place_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "manifest.json"
    os.mkfifo(path)
    assert placeholder(path) == ""
    request: Any = VideoRequest("test", (), None, path, None, {})
    reads: tuple[Callable[[], object], ...] = (
        lambda: read_json(path),
        lambda: open_store(tmp_path),
        lambda: Labels.read(path, {}),
        lambda: select(Source(1), path),
        lambda: _foreign_actions(request, [], presets.debug()),  # type: ignore[arg-type]
        lambda: read_rows(path),
        lambda: read_quarantine(path),
    )
    for read in reads:
        with pytest.raises((UserError, OSError), match="a pipe or device"):
            read()


def test_a_lock_has_one_holder_and_a_place_without_locks_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a" / "lock"
    assert not is_held(path)
    assert not path.exists()
    with lock(path) as free, lock(path) as again:
        assert (free, again) == (True, False)
        assert is_held(path)
    with ThreadPoolExecutor(4) as pool:
        assert not any(pool.map(is_held, [path] * 40)), "readers do not see each other"

    def without(*_: Any, **__: Any) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("rsjax.files.lock_descriptor", without)
    with pytest.raises(UserError, match="this file system has no locks"), lock(path):
        pass
    assert not is_held(path)
    with lock(path, required=False) as free:
        assert free
    assert "no locks, so nothing keeps a second process from writing here" in capsys.readouterr().out


KEEP = """
import sys, time
from pathlib import Path
from rsjax.files import lock
with lock(Path(sys.argv[1])):
    print("ready", flush=True)
    time.sleep(600)
"""


def test_the_lock_of_a_killed_process_is_free_for_one_that_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, said = tmp_path / "lock", list[str]()
    with subprocess.Popen([sys.executable, "-c", KEEP, path], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout and process.stdout.readline() == "ready\n"
        with lock(path) as free:
            assert not free
        who = f"process {process.pid} on {socket.gethostname()}"
        assert holder(path) == who

        def kill(line: str) -> None:
            said.append(line)
            process.kill()

        monkeypatch.setattr("rsjax.files.note", kill)
        with lock(path, wait="waiting for another process") as free:
            assert free
        assert said == [f"waiting for another process ({who})"]
    assert holder(tmp_path / "none") == "another process"


def test_a_data_set_is_made_by_one_process_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "store"
    with making(path, wait=False):
        with pytest.raises(UserError, match=rf"{path}: process {os.getpid()} on .* is making it"), making(path, False):
            pass
        with making(tmp_path / "other", wait=False):
            pass
    assert not path.exists()


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("config.json", read_json),
        ("net.safetensors", read_tensors),
        ("net.ckpt", read_tensors),
        ("lpips.safetensors", load_lpips),
        ("depth.pth", lambda path: require_weights(path, "depth")),
    ],
)
def test_what_a_download_left_in_place_of_a_file_is_named(tmp_path: Path, name: str, read: Any) -> None:
    path = tmp_path / name
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"
    for content, message in (
        (pointer, "a Git-LFS pointer in place of the file: fetch it with git lfs pull"),
        ("<html><body>Not found</body></html>", "a web page in place of the file"),
    ):
        path.write_text(content)
        with pytest.raises(UserError, match=f"{name}: {message}"):
            read(path)


@given(st.binary(max_size=600))
def test_data_are_no_placeholders(content: bytes) -> None:
    assert placeholder(b"\x89" + content) == placeholder(b"{" + content) == ""
    assert placeholder(b"\xef\xbb\xbf <!DOCTYPE HTML>" + content)


def test_only_what_can_be_a_path_is_one(tmp_path: Path) -> None:
    for path in (tmp_path, str(tmp_path), "runs/tiny", "."):
        assert checked_path(path, "run") == Path(path)
    for wrong in (None, 7, b"runs", "", "x" * 256, "x/" * 3000, "a\0b", "\ud800", ["runs"]):
        for refuse in (lambda wrong=wrong: checked_path(wrong, "run"), lambda wrong=wrong: rsjax.load(wrong)):
            with pytest.raises(FileError) as raised:
                refuse()
            assert str(raised.value).startswith("run is ")
        with pytest.raises(UserError):
            rsjax.open_store(wrong)  # type: ignore[arg-type]
        with pytest.raises(UserError):
            rsjax.write_store(wrong, [])  # type: ignore[arg-type]


def test_pipes_are_refused_where_content_is_hashed_or_labels_are_read(tmp_path: Path) -> None:
    """Opening one would wait for ever."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileError):
        content_hash(tmp_path / "pipe")
    with pytest.raises(UserError):
        HumanJudge.read(tmp_path / "pipe")


def test_a_changed_digit_of_sealed_numbers_is_refused(tmp_path: Path) -> None:
    path = tmp_path / FILE
    saved = Normalization((0.125, 2.0), (1.0, 0.5), (0.3, 2.5))
    saved.save(tmp_path)
    assert Normalization.load(tmp_path) == saved
    whole = path.read_text()
    for old, new in (("0.125", "0.725"), ("2.5", "2.7"), ("1.0", "1.8")):
        path.write_text(whole.replace(old, new, 1))
        with pytest.raises(UserError) as raised:
            Normalization.load(tmp_path)
        assert "its checksum is wrong" in str(raised.value)
    values = json.loads(whole)
    del values["crc32"]  # as who edits it on purpose does
    path.write_text(json.dumps(values))
    assert Normalization.load(tmp_path) == saved


def test_a_place_that_nothing_can_be_written_to_is_named_before_the_work(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("something")
    for path in (tmp_path, tmp_path / "new" / "below"):
        check_place(path, "--out", directory=True)
    for path in (file, tmp_path / "new" / "sheet.png"):
        check_place(path, "--sheet", directory=False)
    wrong = [
        (path, True) for path in (file, file / "below", Path("/proc/nowhere"), tmp_path / ("n" * 300), Path("a\0b"))
    ]
    wrong += [(tmp_path, False), (file / "below", False), (Path("/proc/nowhere"), False)]
    for path, directory in wrong:
        with pytest.raises(FileError) as raised:
            check_place(path, "--out", directory)
        assert str(raised.value).startswith("--out is ")
    assert list(tmp_path.iterdir()) == [file]
