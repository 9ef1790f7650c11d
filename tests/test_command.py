"""Tests that a stopped command ends with one line and an exit status, whatever the main thread is doing."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rsjax.command import UNREAD
from rsjax.runtime import ANSWERS, INTERRUPTED, TERMINATED

ROOT = Path(__file__).parents[1]
# A command that runs the lines of its argument, which print "ready" when the signal may come.
PROGRAM = """
import ctypes, os, signal, sys, time
from rsjax import runtime
from rsjax.command import main_errors
runtime.STOP_SECONDS = runtime.REPEAT_SECONDS = 0.2
def blocked():
    mutex, lock = ctypes.create_string_buffer(256), ctypes.CDLL(None).pthread_mutex_lock
    lock(mutex)
    print("ready", flush=True)
    lock(mutex)  # for ever, in C code
def wait():  # in short sleeps: a signal that comes just before a sleep would not end it
    while True:
        time.sleep(0.05)
def said(work):
    print("ready", flush=True)
    work()
with main_errors():
    exec(sys.argv[1])
"""
IN_C = "blocked()"
IN_A_GARBAGE_COLLECTION = """
import gc
runtime.STOP_SECONDS = 600
def callback(phase, info):  # as jax has one
    if phase == "start":
        gc.callbacks.remove(callback)
        said(wait)
gc.callbacks.append(callback)
gc.collect()
time.sleep(600)
"""
IN_AN_IMPORT = """
try:
    said(wait)
except BaseException as error:
    raise ImportError("numpy failed to import") from error
"""
IN_ASYNCIO = """
import asyncio
runtime.STOP_SECONDS = 600
async def main():
    asyncio.get_running_loop().call_soon(said, lambda: time.sleep(600))
    await asyncio.sleep(600)
asyncio.run(main())
"""
CLEANING_UP = """
try:
    said(wait)
finally:
    time.sleep(600)
"""
COMPILING = """
import threading
import jax, jax.numpy as jnp
begun = threading.Event()
def traced(x):
    for _ in range(300):
        x = jnp.sin(x @ x) + jnp.linalg.norm(x)
    begun.set()
    return x
threading.Thread(target=jax.jit(traced), args=(jnp.ones((300, 300)),), daemon=True).start()
begun.wait()
said(wait)
"""


def stopped(lines: str, number: int, again: bool = False) -> tuple[int, str]:
    """Sends a signal to the program, once or until it ends; returns its exit status and last line of errors."""
    line = [sys.executable, "-c", PROGRAM, lines]
    with subprocess.Popen(line, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(number)
        while again and process.poll() is None:
            time.sleep(0.1)
            process.send_signal(number)
        _, errors = process.communicate()
    assert "Traceback (most" not in errors, errors
    return process.returncode, errors.splitlines()[-1]


@pytest.mark.parametrize("lines", [IN_C, IN_AN_IMPORT, CLEANING_UP, IN_A_GARBAGE_COLLECTION, IN_ASYNCIO])
def test_sigterm_ends_a_command_whatever_it_does(lines: str) -> None:
    assert stopped(lines, signal.SIGTERM) == (75, TERMINATED)


@pytest.mark.parametrize("lines", [IN_C, IN_A_GARBAGE_COLLECTION])
def test_a_second_interrupt_ends_a_command_at_once_in_one_line(lines: str) -> None:
    assert stopped(lines, signal.SIGINT, again=True) == (130, INTERRUPTED)


@pytest.mark.parametrize("lines", [IN_AN_IMPORT, IN_A_GARBAGE_COLLECTION, IN_ASYNCIO, COMPILING])
def test_one_interrupt_is_one_line(lines: str) -> None:
    assert stopped(lines, signal.SIGINT) == (130, INTERRUPTED)


@pytest.mark.parametrize(
    ("command", "number"), [("experiments.train", signal.SIGINT), ("experiments.convert", signal.SIGTERM)]
)
def test_a_signal_while_a_command_is_imported_is_one_line(command: str, number: signal.Signals, tmp_path: Path) -> None:
    (tmp_path / "tyro.py").write_text(f"import signal\nsignal.raise_signal({int(number)})")
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{ROOT}"}
    line = [sys.executable, "-m", command]
    done = subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True)
    answer, status = ANSWERS[number]
    assert (done.returncode, done.stderr) == (status, f"{answer}\n")


def test_a_program_that_imports_commands_keeps_its_handlers() -> None:
    program = "import signal, experiments.train, rsjax.tools.convert; print(signal.getsignal(signal.SIGINT).__name__)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "default_int_handler\n"


def test_output_that_nobody_reads_any_more_ends_a_command_without_a_word() -> None:
    lines = "for i in range(10**5): print(i)"
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, lines], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout and process.stderr
        assert process.stdout.readline() == "0\n"
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == UNREAD
