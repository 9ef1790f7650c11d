"""TensorBoard's event files."""

import os
import time
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from tensorboardX import summary
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary


class TensorBoardWriter:
    """Writes scalars and images that TensorBoard shows. Every event is in the file when a call returns, or it raises.

    Not tensorboardX's SummaryWriter, which hands events to a thread: it loses them when the process is killed, and
    blocks forever on a full disk.

    Args:
        directory: where event files go; each start of a run adds one.
        start: the step after which the run resumes; TensorBoard hides later steps of earlier files.
    """

    def __init__(self, directory: Path, start: int) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        # TensorBoard reads files in the order of their names, which begin with the time in whole seconds.
        self._events = EventsWriter(str(directory / "events"), f".{time.time_ns()}.{os.getpid()}")
        self._write(Event(session_log=SessionLog(status=SessionLog.START), step=start + 1))

    def write(self, step: int, scalars: dict[str, float]) -> None:
        """Adds scalars of one step."""
        values = [value for name, number in scalars.items() for value in summary.scalar(name, number).value]
        self._write(Event(summary=Summary(value=values), step=step))

    def image(self, step: int, name: str, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Adds an image, 0–255."""
        self._write(Event(summary=summary.image(name, image, dataformats="HWC"), step=step))

    def close(self, failed: bool) -> None:
        """Closes the file."""
        self._events.close()

    def _write(self, event: Event) -> None:
        event.wall_time = time.time()
        self._events.write_event(event)
        self._events.flush()
