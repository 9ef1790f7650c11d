"""Sets up the process before JAX is imported, and handles the signals that stop it."""

import faulthandler
import gc
import hashlib
import os
import platform
import select
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from rsjax.errors import Preempted

HUGE_PAGES = "glibc.malloc.hugetlb=1"
STOP_SECONDS = 20.0  # for this long SIGTERM may go unanswered; Kubernetes and Slurm kill after 30
REPEAT_SECONDS = 0.5  # two Ctrl-C within this time count as one: wrappers such as make repeat the terminal's
INTERRUPTED = "interrupted; the same command resumes"
TERMINATED = "stopped by SIGTERM; the same command resumes"
ANSWERS = {signal.SIGINT: (INTERRUPTED, 130), signal.SIGTERM: (TERMINATED, os.EX_TEMPFAIL)}

patient = threading.Event()  # set while stopping after SIGTERM may take longer, because steps must be saved first


CACHE_DIRECTORY = "JAX_COMPILATION_CACHE_DIR"
CACHE_SIZE = 4 * 2**30  # bytes of compiled programs that are kept
CACHED_SECONDS = 0.1  # a program that compiles faster is compiled again in about the time that reading it takes
BF16_UNITS = {"avx512_bf16", "amx_bf16", "bf16"}  # as x86 and Arm processors name them
YNNPACK = "--xla_cpu_experimental_ynn_fusion_type"  # the operations that XLA hands to this library
TRITON_PRODUCTS = "--xla_gpu_enable_triton_gemm"
KNOWN = ("0.10.", "0.11.", "0.12.")  # versions of jaxlib that have these flags; an unknown flag would end the process


def tune_process() -> None:
    """Chooses XLA's flags, caches compiled programs between runs, and restarts the process once for huge pages.

    Python looks for garbage less often (:func:`collect_rarely`).

    Compiled programs are cached in ``~/.cache/rsjax``, or in the user's ``JAX_COMPILATION_CACHE_DIR``; if that variable
    is empty, they are not cached.

    The restart keeps the process id and arguments. XLA's CPU backend allocates fresh memory for every step, and
    touching it 4 KiB at a time takes a third of a small model's step. glibc reads its tunables only when a process
    starts, hence the restart. Does not restart if the user has set this tunable, or off Linux.
    """
    set_xla_flags()
    collect_rarely()
    if CACHE_DIRECTORY not in os.environ and (directory := _cache_directory()):
        os.environ |= {CACHE_DIRECTORY: str(directory), "JAX_COMPILATION_CACHE_MAX_SIZE": str(CACHE_SIZE)}
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if not sys.platform.startswith("linux") or "glibc.malloc.hugetlb" in tunables:
        return
    if sys.stdout is not None:
        sys.stdout.flush()
    tuned = os.environ | {"GLIBC_TUNABLES": f"{tunables}:{HUGE_PAGES}".lstrip(":")}
    os.execve(sys.executable, sys.orig_argv, tuned)


def keep_compiled_programs() -> None:
    """Caches compiled programs where commands do, for a process that rsjax did not start; environments call it.

    The setting is jax's own, so programs of the rest of the process are kept too. Does nothing if the user chose a
    directory or none, by ``JAX_COMPILATION_CACHE_DIR`` or in ``jax.config``.
    """
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    chosen = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined] # jax makes it at run time
    directory = _cache_directory()
    if CACHE_DIRECTORY in os.environ or chosen is not None or directory is None:
        return
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_compilation_cache_max_size", CACHE_SIZE)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", CACHED_SECONDS)
    compilation_cache.reset_cache()  # jax looks for its directory at the first program, which may have run


def drop_compiled_programs(most: int) -> bool:
    """Drops the compiled programs that jax keeps if the process has more than ``most`` pieces of mapped memory.

    A program takes several pieces. Linux gives a process 65,530, and at the next one XLA ends it. Off Linux, where
    nothing counts them, programs are always dropped. Those in the cache on disk stay.

    Returns:
        Whether it dropped them.
    """
    with suppress(OSError):
        if Path("/proc/self/maps").read_bytes().count(b"\n") <= most:
            return False
    import jax

    jax.clear_caches()
    return True


def _cache_directory() -> Path | None:
    """Returns the directory of compiled programs; None if the user has no home directory.

    Machines that share a home may have different processors, whose programs must not be mixed: hence one directory for
    each set of instructions.
    """
    try:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        return None
    return home / "rsjax" / f"xla-{hashlib.sha256(_processor().encode()).hexdigest()[:8]}"


def set_xla_flags() -> None:
    """Chooses libraries for products and convolutions. Leaves flags alone that the user set.

    On x86 processors, keeps convolutions from YNNPACK, and matrix products where there are no bf16 units. YNNPACK
    convolves on one core only. Without bf16 units, XLA's own products of bf16 operands are twice as fast
    (``notebooks/cpu-performance.md``). Sums and maxima stay with YNNPACK.

    On GPUs, leaves matrix products to cuBLAS, which adds bias and residual in the same kernel; XLA's own do not.
    """
    if not version("jaxlib").startswith(KNOWN):
        return
    flags = os.environ.get("XLA_FLAGS", "").split()
    if platform.machine() == "x86_64":
        kinds = ["REDUCE", "DOT", "INDIVIDUAL_DOT"] if has_bf16_units() else ["REDUCE"]
        flags = _with_flag(flags, YNNPACK, ",".join(f"LIBRARY_FUSION_TYPE_{kind}" for kind in kinds))
    os.environ["XLA_FLAGS"] = " ".join(_with_flag(flags, TRITON_PRODUCTS, "false"))


def collect_rarely() -> None:
    """Makes Python look for garbage less often, since tracing a model makes millions of objects that are not garbage.

    By default it looks after every 700 new objects, which takes a sixteenth of the processor time of a short rollout.
    """
    gc.set_threshold(100_000, 50, 100)


def _with_flag(flags: list[str], name: str, value: str) -> list[str]:
    if any(flag.startswith(name) for flag in flags):
        return flags
    return [*flags, f"{name}={value}"]


def has_bf16_units() -> bool:
    """Says whether the processor multiplies bf16 in hardware; False where this is not known (off Linux)."""
    return not BF16_UNITS.isdisjoint(_processor().split())


@cache
def _processor() -> str:
    """Returns the names of the processor's instruction sets; off Linux only that of its architecture."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next((line for line in lines if line.startswith(("flags", "Features"))), platform.machine())
    return platform.machine()


def answer_while_importing() -> None:
    """Lets Ctrl-C and SIGTERM end a command with one line while its modules are imported.

    A package of commands calls this before it imports anything else; :func:`stop_signals` takes over. Does nothing
    if another program imports the package.
    """
    # "-m" is what Python sets while it looks for the module to run; rsjax is the script that an installation makes.
    if not sys.argv or (sys.argv[0] != "-m" and Path(sys.argv[0]).name != "rsjax"):
        return
    for number, answer in ANSWERS.items():
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_, answer=answer: _end(*answer))


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Wraps a command; yields a list, to which each signal that asks the command to stop is added.

    SIGTERM, by which schedulers end a process, raises :class:`Preempted`, and Ctrl-C raises :class:`KeyboardInterrupt`,
    each once, and once more if Python ignored the exception, as it does in finalizers and in jax's callback for garbage
    collection. Training loops save first (:mod:`rsjax.training.preemption`). SIGUSR1 prints the stack of every thread.

    Python raises these exceptions in the main thread only, and not while that thread runs C code, such as XLA's
    compiler. So another thread ends the process at a second Ctrl-C, and :data:`STOP_SECONDS` after SIGTERM unless
    :data:`patient` is set. Nothing is lost: all files are written atomically.

    Does nothing off the main thread, the only one that may handle signals.
    """
    received: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        if number in received:  # let the clean-up go on
            return
        received.append(number)
        raise KeyboardInterrupt if number == signal.SIGINT else Preempted(TERMINATED)

    def raise_again(unraisable: Any) -> None:
        for number, kind in ((signal.SIGTERM, Preempted), (signal.SIGINT, KeyboardInterrupt)):
            if number in received and isinstance(unraisable.exc_value, kind):
                received.remove(number)
                threading.Timer(0.05, os.kill, (os.getpid(), number)).start()
                return
        report(unraisable)

    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    faulthandler.register(signal.SIGUSR1, file=2)
    # A command that was started by nohup, or in a shell's background, ignores Ctrl-C.
    numbers = [number for number in (signal.SIGTERM, signal.SIGINT) if signal.getsignal(number) != signal.SIG_IGN]
    readable, writable = os.pipe()
    os.set_blocking(writable, False)
    watch = threading.Thread(target=_watch, args=(readable,), daemon=True)
    watch.start()
    descriptor = signal.set_wakeup_fd(writable, warn_on_full_buffer=False)
    report = sys.unraisablehook
    sys.unraisablehook = raise_again
    before = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = report
        signal.set_wakeup_fd(descriptor)
        os.write(writable, bytes(1))  # a forked child may hold the pipe open
        os.close(writable)
        watch.join()
        os.close(readable)


def _watch(pipe: int) -> None:
    """Reads signal numbers from a pipe, which Python's C handler fills whatever the main thread is doing."""
    interrupted = float("inf")
    deadline = float("inf")
    while True:
        now = time.monotonic()
        wait = None if deadline == float("inf") else max(0.0, deadline - now)
        if not select.select([pipe], [], [], wait)[0]:
            if not patient.is_set():
                _end(*ANSWERS[signal.SIGTERM])
            os.kill(os.getpid(), signal.SIGTERM)  # the exception may have been swallowed before training began
            deadline = time.monotonic() + STOP_SECONDS
            continue
        numbers = os.read(pipe, 64)
        now = time.monotonic()
        if not numbers or 0 in numbers:  # the end
            return
        if signal.SIGINT in numbers:
            interrupted = min(interrupted, now)
            if now - interrupted > REPEAT_SECONDS:
                _end(*ANSWERS[signal.SIGINT])
        if signal.SIGTERM in numbers:
            deadline = min(deadline, now + STOP_SECONDS)


def _end(line: str, status: int) -> NoReturn:
    os.write(2, f"{line}\n".encode())
    exit_now(status)


def exit_now(status: int) -> NoReturn:
    """Ends the process after flushing its output, without the interpreter's exit, which crashes when XLA's threads run.

    Worker processes end with this one.
    """

    def flush() -> None:
        if sys.stdout.isatty():
            sys.stdout.write("\x1b[?25h")  # a progress bar may have hidden the cursor
        sys.stdout.flush()
        sys.stderr.flush()

    thread = threading.Thread(target=flush, daemon=True)
    thread.start()
    thread.join(1.0)  # whoever reads the output may have stopped reading
    os._exit(status)
