"""Settings that have to stand before jax is loaded, here and in the processes that tests start."""

import importlib.util
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from rsjax.runtime import set_xla_flags

# The tests compile thousands of small programs and run each a few times: compiling is most of their time. Without
# LLVM's optimisations it takes half, without the fusion emitters (which write more code) a quarter less again. How fast
# programs run is for benchmarks.
FLAGS = {"--xla_backend_optimization_level": "0", "--xla_cpu_use_fusion_emitters": "false"}
for flag, value in FLAGS.items():
    if flag not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}={value}".strip()

set_xla_flags()  # as every command does

# What one process compiles, the others (pytest's workers, the commands that tests start) load. The directory lasts as
# long as the session: name one in JAX_COMPILATION_CACHE_DIR to keep it. Reading it changes no result: a program is the
# same whether it was compiled or loaded.
CACHE = "JAX_COMPILATION_CACHE_DIR"
made = "" if CACHE in os.environ else tempfile.mkdtemp(prefix="rsjax-tests-")
os.environ.setdefault(CACHE, made)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def pytest_unconfigure() -> None:
    if made:
        shutil.rmtree(made, ignore_errors=True)


# A shell's background job ignores Ctrl-C, and so would the commands that tests start and interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A machine that is busy with something else fails no test.
settings.register_profile("any-speed", settings(), deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any-speed")

# Directories whose tests take longest. They come first, so that no worker is left with one of them at the end.
LONGEST = ("reliability", "pipeline", "ablation", "models", "training")


@pytest.fixture
def bf16_units(monkeypatch: pytest.MonkeyPatch) -> None:
    """Takes the bf16 products on processors without units for them too."""
    monkeypatch.setattr("rsjax.matmul.has_bf16_units", lambda: True)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    order = {name: place for place, name in enumerate(LONGEST)}
    root = config.rootpath / "tests"
    items.sort(key=lambda item: order.get(item.path.relative_to(root).parts[0], len(order)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Gives each file to one worker, which then compiles the programs that its tests share once."""
    from xdist.scheduler import LoadFileScheduling

    config.option.loadscopereorder = False
    return LoadFileScheduling(config, log)


def _operators() -> object:
    """Lets a torchvision that was built for CUDA be imported beside a torch without.

    Its compiled part does not load there, and the import then wants these two operators declared. RAFT and image
    processors are plain Python and call neither. Beside its own torch nothing is needed.
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


_OPERATORS = _operators()  # undeclared again when it is deleted


@pytest.fixture(scope="session")
def gl() -> str:
    """Skips a test that renders where nothing can."""
    from rsjax.sim.gl import GLError, choose_gl

    try:
        return choose_gl()
    except GLError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless Chromium, steered by Playwright; skips where either is missing (make extras installs both).

    Until it is closed, an event loop runs in this thread, and others (Ray's) cannot.
    """
    api = pytest.importorskip("playwright.sync_api")
    path = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    if not path:
        pytest.skip("no Chromium: apt-get install chromium, or name one in CHROMIUM")
    with api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield opened
        opened.close()
