from pathlib import Path

from rsjax.train.log import NAME, ScalarLog, read_log


def write(directory: Path, start: int, steps: range) -> None:
    with ScalarLog(directory, start) as log:
        for step in steps:
            log.write(step, {"loss": 1 / step})


def test_what_was_logged_is_read(tmp_path: Path) -> None:
    assert read_log(tmp_path) == []
    write(tmp_path, 0, range(1, 4))
    assert read_log(tmp_path) == [{"step": step, "loss": 1 / step} for step in range(1, 4)]
    assert list((tmp_path / "tensorboard").iterdir())


def test_a_resumed_log_drops_what_will_be_done_again(tmp_path: Path) -> None:
    write(tmp_path, 0, range(1, 8))
    write(tmp_path, 4, range(5, 7))
    assert [row["step"] for row in read_log(tmp_path)] == [1, 2, 3, 4, 5, 6]


def test_a_torn_last_line_is_left_out_and_cured_on_resume(tmp_path: Path) -> None:
    write(tmp_path, 0, range(1, 4))
    path = tmp_path / NAME
    path.write_bytes(path.read_bytes()[:-9])
    assert [row["step"] for row in read_log(tmp_path)] == [1, 2]
    write(tmp_path, 2, range(3, 5))
    assert [row["step"] for row in read_log(tmp_path)] == [1, 2, 3, 4]
