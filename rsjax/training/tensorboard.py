"""TensorBoard's event files."""

import os
import socket
import struct
import time
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from tensorboardX import summary
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary
from tensorboardX.record_writer import masked_crc32c


class Board:
    """Writes scalars and pictures that TensorBoard shows.

    tensorboardX's own writer hands events to a thread: what it still holds is lost when the process is killed, and on a
    full disk it stops for ever. Here every event is in the file when the call returns, or the call raises.

    Args:
        directory: where the event files lie; each start of a run adds one.
        start: the step that the run resumes after; what earlier files have of later steps is no longer shown.
    """

    def __init__(self, directory: Path, start: int) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        seconds, rest = divmod(time.time_ns(), 10**9)
        # TensorBoard reads files in the order of their names.
        name = f"events.out.tfevents.{seconds:010d}.{rest:09d}.{socket.gethostname()}.{os.getpid()}"
        self._file = (directory / name).open("xb")
        self._write(Event(file_version="brain.Event:2"))
        self._write(Event(session_log=SessionLog(status=SessionLog.START), step=start + 1))

    def write(self, step: int, scalars: dict[str, float]) -> None:
        """Adds scalars of one step."""
        values = [value for name, number in scalars.items() for value in summary.scalar(name, number).value]
        self._write(Event(summary=Summary(value=values), step=step))

    def image(self, step: int, name: str, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Adds a picture, 0–255."""
        self._write(Event(summary=summary.image(name, image, dataformats="HWC"), step=step))

    def close(self, failed: bool) -> None:
        """Closes the file."""
        self._file.close()

    def _write(self, event: Event) -> None:
        event.wall_time = time.time()
        data = event.SerializeToString()
        size = struct.pack("<Q", len(data))
        checks = [struct.pack("<I", masked_crc32c(part)) for part in (size, data)]
        self._file.write(size + checks[0] + data + checks[1])  # a TFRecord
        self._file.flush()
