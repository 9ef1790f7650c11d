import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.record_writer import masked_crc32c

from rsjax.files import FileError
from rsjax.training.log import LOG as NAME
from rsjax.training.log import MEASURED, ScalarLog, read_curve, read_log

PICTURE = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)


def write(directory: Path, start: int, steps: range) -> None:
    with ScalarLog(directory, start) as log:
        for step in steps:
            log.write(step, {"loss": 1 / step})


def events(path: Path) -> list[Event]:
    """Reads a TensorBoard file's events by its format: length, its checksum, event, its checksum."""
    data, read = path.read_bytes(), []
    while data:
        (size,), head = struct.unpack("<Q", data[:8]), data[:8]
        body = data[12 : 12 + size]
        assert struct.unpack("<I", data[8:12])[0] == masked_crc32c(head)
        assert struct.unpack("<I", data[12 + size : 16 + size])[0] == masked_crc32c(body)
        read.append(Event.FromString(body))
        data = data[16 + size :]
    return read


def in_tensorboard(directory: Path) -> list[tuple[int, dict[str, Any]]]:
    """Returns what TensorBoard shows: it reads files in the order of their names; each start hides repeated steps."""
    shown: list[tuple[int, dict[str, Any]]] = []
    for path in sorted((directory / "tensorboard").iterdir()):
        for event in events(path):
            if event.HasField("session_log"):
                shown = [row for row in shown if row[0] < event.step]
            elif event.summary.value:
                shown.append((event.step, {value.tag: value for value in event.summary.value}))
    return shown


def test_logged_rows_are_read_and_a_resumed_log_drops_steps_that_will_be_repeated(tmp_path: Path) -> None:
    assert read_log(tmp_path) == []
    write(tmp_path, 0, range(1, 8))
    write(tmp_path, 4, range(5, 7))
    assert read_log(tmp_path) == [{"step": step, "loss": 1 / step} for step in range(1, 7)]


def test_a_torn_last_line_is_left_out_and_repaired_on_resume(tmp_path: Path) -> None:
    write(tmp_path, 0, range(1, 4))
    path = tmp_path / NAME
    path.write_bytes(path.read_bytes()[:-9])
    assert [row["step"] for row in read_log(tmp_path)] == [1, 2]
    write(tmp_path, 2, range(3, 5))
    assert [row["step"] for row in read_log(tmp_path)] == [1, 2, 3, 4]


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(1, 4)), min_size=1, max_size=4))
@settings(max_examples=20, deadline=None)
def test_tensorboard_shows_the_same_as_the_log(
    tmp_path_factory: pytest.TempPathFactory, starts: list[tuple[int, int]]
) -> None:
    directory = tmp_path_factory.mktemp("log")
    for start, count in starts:
        write(directory, start, range(start + 1, start + 1 + count))
    shown = [(step, values["loss"].simple_value) for step, values in in_tensorboard(directory)]
    assert shown == [(row["step"], np.float32(row["loss"])) for row in read_log(directory)]


def test_scalars_and_pictures_are_in_tensorboards_file_before_the_log_is_closed(tmp_path: Path) -> None:
    with ScalarLog(tmp_path, 0) as log:
        log.write(3, {"loss": 0.5, "validation/psnr": 21.25})
        log.image(3, "clip_000", PICTURE)
        (scalars, picture) = (values for _, values in in_tensorboard(tmp_path))
    assert {tag: value.simple_value for tag, value in scalars.items()} == {"loss": 0.5, "validation/psnr": 21.25}
    assert (picture["clip_000"].image.height, picture["clip_000"].image.width) == PICTURE.shape[:2]


def test_an_image_is_saved_unchanged_under_its_step(tmp_path: Path) -> None:
    with ScalarLog(tmp_path, 0) as log:
        log.image(20, "clip_000", PICTURE)
    (path,) = (tmp_path / "pictures").iterdir()
    assert path.name == "clip_000-0000020.png"
    np.testing.assert_array_equal(np.asarray(Image.open(path)), PICTURE)


def test_machine_measurements_are_not_in_the_curve(tmp_path: Path) -> None:
    with ScalarLog(tmp_path, 0) as log:
        log.write(1, {"loss": 0.5} | dict.fromkeys([*MEASURED, "frames_per_second", "samples_per_second"], 1.0))
    assert read_curve(tmp_path) == [{"step": 1, "loss": 0.5}]


def test_a_full_disk_is_reported_at_its_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = 0

    def training() -> None:
        nonlocal step
        with ScalarLog(tmp_path, 0) as log:
            monkeypatch.setattr(log, "_file", Path("/dev/full").open("w"))  # noqa: SIM115
            for step in (1, 2):
                log.write(step, {"loss": 0.5})

    with pytest.raises(FileError, match="the disk is full"):
        training()
    assert step == 1
