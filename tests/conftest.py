"""Settings that must be made before jax is loaded, here and in the processes that tests start; shared fixtures."""

import faulthandler
import gc
import importlib.util
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from rsjax.runtime import collect_rarely, drop_compiled_programs, set_xla_flags

# The tests compile thousands of small programs and run each a few times, so most of their time is compilation. Without
# LLVM's optimisations, compilation takes half the time; without the fusion emitters, which produce more code, it takes
# another quarter less, and as one module, which one thread compiles, a seventh less. The speed of the compiled programs
# matters only for benchmarks.
FLAGS = {
    "--xla_backend_optimization_level": "0",
    "--xla_cpu_use_fusion_emitters": "false",
    "--xla_cpu_parallel_codegen_split_count": "1",
}
if not version("jaxlib").startswith("0.10."):
    del FLAGS["--xla_cpu_use_fusion_emitters"]  # a process that meets a flag that it does not know ends
for flag, value in FLAGS.items():
    if flag not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}={value}".strip()

# As every command does.
set_xla_flags()
collect_rarely()

# Programs that one process compiles are loaded by the others (pytest's workers, the commands that tests start). The
# directory is deleted at the end of the session; to keep one, name it in JAX_COMPILATION_CACHE_DIR. The cache changes
# no result: a program is the same whether it was compiled or loaded.
CACHE = "JAX_COMPILATION_CACHE_DIR"
made = "" if CACHE in os.environ else tempfile.mkdtemp(prefix="rsjax-tests-")
os.environ.setdefault(CACHE, made)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


TERMINAL = pytest.StashKey[int]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[TERMINAL] = os.dup(2)  # while nothing is captured


@pytest.hookimpl(trylast=True)
def pytest_exception_interact(node: pytest.Item | pytest.Collector) -> None:
    """Times what follows a failure as well: pytest stops its clock there, and a hanging teardown would go unnoticed."""
    if isinstance(node, pytest.Item):
        seconds = float(node.config.getini("faulthandler_timeout"))
        faulthandler.dump_traceback_later(seconds, file=node.config.stash[TERMINAL], exit=True)


def pytest_unconfigure() -> None:
    if made:
        shutil.rmtree(made, ignore_errors=True)


# A background job of a shell ignores Ctrl-C, and so would the commands that the tests start and interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tests must not fail because the machine is busy with something else.
settings.register_profile("any-speed", settings(), deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any-speed")

# Directories whose tests take longest. They run first, so that no worker still has one of them left at the end.
LONGEST = ("models", "reliability", "tools/pipeline", "tools/studies", "training", "tools/policies")


PIECES_OF_PROGRAMS = 30_000  # of mapped memory, about 6 GB


@pytest.fixture(scope="module", autouse=True)
def earlier_objects() -> None:
    """Spares the collector the millions of objects that the tests of earlier files have left, such as programs.

    robosuite collects whenever it closes a simulator, and with those objects this takes seconds each time. Programs go
    before there are too many.
    """
    if drop_compiled_programs(PIECES_OF_PROGRAMS):
        gc.unfreeze()
    gc.collect()
    gc.freeze()


@pytest.fixture
def bf16_units(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes processors without bf16 units compute products in bf16 as well."""
    monkeypatch.setattr("rsjax.runtime.has_bf16_units", lambda: True)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    def place(item: pytest.Item) -> int:
        name = item.path.relative_to(config.rootpath / "tests").as_posix()
        return next((place for place, folder in enumerate(LONGEST) if name.startswith(f"{folder}/")), len(LONGEST))

    items.sort(key=place)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Gives each file to one worker, which then compiles the programs that the file's tests share only once."""
    from xdist.scheduler import LoadFileScheduling

    config.option.loadscopereorder = False
    return LoadFileScheduling(config, log)


def _operators() -> object:
    """Makes a torchvision that was built for CUDA importable with a torch that was built without it.

    With such a torch, torchvision's compiled part does not load, and its import then needs these two operators to be
    declared. RAFT and the image processors are plain Python and call neither. With a matching torch, nothing is done.
    """
    if not (importlib.util.find_spec("torch") and importlib.util.find_spec("torchvision")):
        return None
    import torch

    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        declared = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            declared.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        return declared
    return None


_OPERATORS = _operators()  # kept, because the operators exist only as long as this object


@pytest.fixture(scope="session")
def gl() -> str:
    """Returns the way to render without a screen; skips the test on a machine that cannot render."""
    from rsjax.tools.sim.gl import GLError, choose_gl

    try:
        return choose_gl()
    except GLError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Yields a headless Chromium, controlled by Playwright; skips if either is missing (make extras installs both).

    Until the browser is closed, an event loop runs in this thread, so other event loops (Ray's) cannot run.
    """
    api = pytest.importorskip("playwright.sync_api")
    path = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    if not path:
        pytest.skip("no Chromium: apt-get install chromium, or name one in CHROMIUM")
    with api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield opened
        opened.close()
