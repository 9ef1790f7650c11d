"""What a training run records: scalars and images as JSON lines, in TensorBoard and W&B, and skipped steps.

``log.jsonl`` is the record that a resumed run continues exactly; TensorBoard and W&B are views of it.
"""

import importlib
import io
import json
import os
import time
import uuid
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any, Self

import jax
import numpy as np
from jaxtyping import UInt8
from PIL import Image
from tensorboardX import summary
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary

from rsjax.errors import UserError, first_line
from rsjax.files import FileError, disk_guard, read_json, read_json_lines, write_file, write_json
from rsjax.progress import note

LOG = "log.jsonl"
PICTURES = "pictures"
SKIPPED = "skipped.jsonl"
WANDB_ID = "wandb.json"
GIB = 2.0**30
# Scalars that measure the machine: they differ between any two runs.
MEASURED = frozenset({"seconds_per_step", "data_wait_share", "device_gib", "device_peak_gib", "host_gib"})
RATE = "_per_second"  # ends the names of others, such as frames_per_second


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Reads a file of JSON lines, each with its ``step``. Returns [] if there is none; a torn last line is left out.

    Raises:
        FileError: the file cannot be read, or another line is damaged.
    """
    return read_json_lines(path, "step", int)


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """Writes a file of JSON lines as :func:`rsjax.files.write_file` does."""
    write_file(path, "".join(json.dumps(row) + "\n" for row in rows).encode())


def read_log(directory: Path) -> list[dict[str, Any]]:
    """Reads all logged steps: dicts of "step" and scalars. A step with validation scalars has a second row for them."""
    return read_rows(directory / LOG)


def read_curve(directory: Path) -> list[dict[str, Any]]:
    """Reads the log without machine measurements: an interrupted run gives the same rows as an uninterrupted one."""
    return [
        {name: value for name, value in row.items() if name not in MEASURED and not name.endswith(RATE)}
        for row in read_log(directory)
    ]


class ScalarLog:
    """Appends to a directory's log, after cutting off the steps that a resumed run repeats.

    Args:
        directory: where ``log.jsonl``, ``tensorboard/``, ``pictures/`` and W&B's files go.
        start: the step after which the run resumes.
        wandb: the Weights & Biases project to log to as well; "": none.
        resume: False starts a new W&B run even if there is one.

    Raises:
        FileError: the disk is full.
        WandbError: Weights & Biases is missing or cannot start.
    """

    def __init__(self, directory: Path, start: int, wandb: str = "", resume: bool = True) -> None:
        self._directory = directory
        kept = [row for row in read_log(directory) if row["step"] <= start]
        with disk_guard(directory):
            write_rows(directory / LOG, kept)
            self._file = (directory / LOG).open("a")
            self._views: list[TensorBoardWriter | WandbRun] = [TensorBoardWriter(directory / "tensorboard", start)]
        if wandb:
            self._views.append(WandbRun(directory, wandb, resume))

    def write(self, step: int, scalars: dict[str, float]) -> None:
        """Logs scalars of one step.

        Raises:
            FileError: the disk is full.
        """
        with disk_guard(self._directory):
            self._file.write(json.dumps({"step": step} | scalars) + "\n")
            self._file.flush()
            for view in self._views:
                view.write(step, scalars)

    def image(self, step: int, name: str, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Logs an image, 0–255, and writes it to ``pictures/LOG-STEP.png``.

        Raises:
            FileError: the disk is full.
        """
        path = self._directory / PICTURES / f"{name}-{step:07d}.png"
        buffer = io.BytesIO()
        Image.fromarray(image).save(buffer, "PNG")
        with disk_guard(self._directory):
            write_file(path, buffer.getvalue())
            for view in self._views:
                view.image(step, name, image)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        def guard() -> AbstractContextManager[None]:
            # Errors here must not replace the one under way, which may be the same full disk.
            return disk_guard(self._directory) if kind is None else suppress(OSError)

        with guard():
            self._file.close()
        for view in self._views:
            with guard():
                view.close(failed=kind is not None)


def read_skipped(directory: Path) -> list[dict[str, Any]]:
    """Reads the skipped steps of a training stage.

    Returns:
        A dict for each: ``step``; ``loss`` and ``grad_norm`` as text, because JSON has no NaN; ``records``, the clips'
        files and origins; ``data``, the loader's state before the batch, from which
        :meth:`rsjax.data.curriculum.LoaderFactory.replay` reads it again.
    """
    return read_rows(directory / SKIPPED)


class SkippedSteps:
    """Keeps ``skipped.jsonl`` in a training stage's directory; without a skipped step there is no file.

    Args:
        start: the step after which the run resumes; later lines are cut off.
    """

    def __init__(self, directory: Path, start: int) -> None:
        self._path = directory / SKIPPED
        self._rows = [row for row in read_skipped(directory) if row["step"] <= start]
        if self._path.exists():
            write_rows(self._path, self._rows)

    def add(self, step: int, scalars: dict[str, float], records: list[dict[str, Any]], data: dict[str, Any]) -> None:
        """Adds a step.

        Raises:
            FileError: the disk is full.
        """
        reason = {name: str(scalars[name]) for name in ("loss", "grad_norm")}
        self._rows.append({"step": step, **reason, "records": records, "data": data})
        write_rows(self._path, self._rows)


def memory_scalars() -> dict[str, float]:
    """Returns memory use in GiB.

    ``device_gib`` and ``device_peak_gib`` are the use and peak use of the fullest of this process's devices; on a
    device without such counts, such as a CPU, those of the process. ``host_gib`` is the process's resident set; 0 if
    the operating system is not Linux.
    """
    host = 0
    host_peak = 0
    status = Path("/proc/self/status")
    if status.exists():  # psutil has no peak
        fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
        host, host_peak = (int(fields[name].split()[0]) * 1024 for name in ("VmRSS", "VmHWM"))
    stats = [device.memory_stats() or {} for device in jax.local_devices()]
    now = max((s["bytes_in_use"] for s in stats if "bytes_in_use" in s), default=host)
    peak = max((s["peak_bytes_in_use"] for s in stats if "peak_bytes_in_use" in s), default=host_peak)
    return {"device_gib": now / GIB, "device_peak_gib": max(now, peak) / GIB, "host_gib": host / GIB}


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


class WandbError(UserError):
    """Weights & Biases is missing or cannot start. The message names the cure."""


def find_wandb() -> ModuleType:
    """Returns the ``wandb`` package.

    Raises:
        WandbError: it is not installed.
    """
    try:
        wandb = importlib.import_module("wandb")
        wandb.init  # noqa: B018  # a folder ./wandb, where W&B keeps its files, can be imported too
    except (ImportError, AttributeError) as error:
        raise WandbError("--runtime.wandb needs Weights & Biases; install it: pip install 'rsjax[wandb]'") from error
    return wandb


class WandbRun:
    """The Weights & Biases run of one trained stage, which continues after every interruption.

    Its id is in ``wandb.json`` next to the log. ``WANDB_MODE=offline`` keeps everything on disk. Once the run has
    started, an error of W&B never stops training: it is reported once, and the mirror stays off until the next start.

    Args:
        directory: the stage's; ``config.json`` in the directory above becomes W&B's configuration.
        project: W&B's project.
        resume: False starts a new W&B run.

    Raises:
        WandbError: the package is missing or cannot start.
    """

    def __init__(self, directory: Path, project: str, resume: bool = True) -> None:
        self._wandb = find_wandb()
        run_directory = directory.absolute().parent
        config = run_directory / "config.json"
        try:
            path = directory / WANDB_ID
            run_id = None
            with suppress(FileError):
                kept = read_json(path)
                if resume and kept.get("project") == project:
                    run_id = kept["id"]
            if run_id is None:
                run_id = uuid.uuid4().hex[:12]
                write_json(path, {"project": project, "id": run_id})
            self._run = self._wandb.init(
                project=project,
                id=run_id,
                resume="allow",
                name=f"{run_directory.name}/{directory.name}",
                group=run_directory.name,
                job_type=directory.name,
                config=read_json(config) if config.exists() else {},
                dir=str(directory),
                settings=self._wandb.Settings(console="off", quiet=True),
            )
            # W&B's own step cannot go back, but after a kill the steps since the last checkpoint are logged again.
            self._run.define_metric("step")
            self._run.define_metric("*", step_metric="step")
        except Exception as error:  # W&B reports a missing or refused key and a missing network as errors of many types
            raise WandbError(
                f"Weights & Biases cannot start ({first_line(error)}); log in (wandb login), set WANDB_MODE=offline, "
                f"or leave --runtime.wandb out"
            ) from error
        note(f"Weights & Biases: {self._run.url or f'offline, {self._run.dir}'}")

    def write(self, step: int, scalars: dict[str, float]) -> None:
        """Logs scalars of one step."""
        self._guarded(lambda run: run.log({"step": step} | scalars))

    def image(self, step: int, name: str, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Logs an image, 0–255."""
        self._guarded(lambda run: run.log({"step": step, name: self._wandb.Image(image)}))

    def close(self, failed: bool) -> None:
        """Waits until W&B has everything; it shows the run as ``failed`` or finished."""
        self._guarded(lambda run: run.finish(exit_code=int(failed)))

    def _guarded(self, work: Callable[[Any], None]) -> None:
        if self._run is None:
            return
        try:
            work(self._run)
        except Exception as error:  # as above
            self._run = None
            note(f"Weights & Biases is off until the next start ({first_line(error)}); training continues")
