import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from rsjax import runtime
from rsjax.runtime import CACHE_DIRECTORY, HUGE_PAGES, TRITON_PRODUCTS, YNNPACK, set_xla_flags, tune_process

CUBLAS = f"{TRITON_PRODUCTS}=false"

ROOT = Path(__file__).parents[1]
# A program that prints its tunables and arguments, and appends its process id to a file at each start.
PROGRAM = """
import os, sys
open(sys.argv[1], "a").write(f"{os.getpid()} ")
from rsjax.runtime import tune_process
tune_process()
print(os.environ.get("GLIBC_TUNABLES"), *sys.argv[2:], sep="\\n")
"""

# A program that compiles one program before, and one that takes a while after.
KEEPING = """
import jax
from rsjax.runtime import keep_compiled_programs
jax.jit(lambda x: x + 1)(1.0)
keep_compiled_programs()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
def slow(x): return x + 2
jax.jit(slow)(1.0)
"""

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="tuning is only for Linux")


def run(starts: Path, tunables: str | None, *arguments: str) -> tuple[list[str], list[str]]:
    """Runs the program; returns the lines that it printed and the process id of each of its starts."""
    environment = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"}
    environment |= {"GLIBC_TUNABLES": tunables} if tunables is not None else {}
    line = [sys.executable, "-X", "dev", "-c", PROGRAM, str(starts), *arguments]
    done = subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines(), starts.read_text().split()


@pytest.mark.parametrize(
    ("before", "after"),
    [(None, HUGE_PAGES), ("glibc.malloc.check=1", f"glibc.malloc.check=1:{HUGE_PAGES}")],
)
def test_restarts_once_as_the_same_process_with_the_same_arguments(
    tmp_path: Path, before: str | None, after: str
) -> None:
    lines, starts = run(tmp_path / "starts", before, "--flag", "two words", "")
    assert lines == [after, "--flag", "two words", ""]
    assert len(starts) == 2
    assert len(set(starts)) == 1


def test_a_tunable_that_the_user_set_stays(tmp_path: Path) -> None:
    lines, starts = run(tmp_path / "starts", "glibc.malloc.hugetlb=0", "a")
    assert lines == ["glibc.malloc.hugetlb=0", "a"]
    assert len(starts) == 1


@pytest.mark.parametrize("set_by_user", [None, "", "/elsewhere"])
def test_compiled_programs_are_kept_in_the_users_cache_unless_told_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, set_by_user: str | None
) -> None:
    monkeypatch.setattr(os, "execve", lambda *_: None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_MAX_SIZE", "-1")  # restored after the test
    if set_by_user is not None:
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", set_by_user)
    tune_process()
    chosen = os.environ["JAX_COMPILATION_CACHE_DIR"]
    assert chosen == set_by_user if set_by_user is not None else chosen.startswith(str(tmp_path / "rsjax" / "xla-"))


@pytest.mark.parametrize(("set_by_user", "kept"), [(None, True), ("", False)])
def test_a_process_that_makes_an_environment_keeps_programs_too(
    tmp_path: Path, set_by_user: str | None, kept: bool
) -> None:
    """Also those that are compiled after others."""
    environment = {name: value for name, value in os.environ.items() if name != CACHE_DIRECTORY}
    environment |= {"XDG_CACHE_HOME": str(tmp_path)}
    if set_by_user is not None:
        environment[CACHE_DIRECTORY] = set_by_user
    subprocess.run([sys.executable, "-c", KEEPING], cwd=ROOT, env=environment, check=True)
    assert bool(list(tmp_path.glob("rsjax/xla-*/jit_slow*"))) == kept


@pytest.mark.parametrize(
    ("processor", "machine", "jaxlib", "before", "after"),
    [
        ("flags : fma avx512f", "x86_64", "0.10.2", "", f"{YNNPACK}=LIBRARY_FUSION_TYPE_REDUCE {CUBLAS}"),
        ("flags : fma avx512f", "x86_64", "0.10.2", "--a=1", f"--a=1 {YNNPACK}=LIBRARY_FUSION_TYPE_REDUCE {CUBLAS}"),
        ("flags : fma avx512f", "x86_64", "0.10.2", f"{YNNPACK}=X", f"{YNNPACK}=X {CUBLAS}"),
        (
            "flags : fma avx512f avx512_bf16",
            "x86_64",
            "0.10.2",
            "",
            f"{YNNPACK}=LIBRARY_FUSION_TYPE_REDUCE,LIBRARY_FUSION_TYPE_DOT,LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT {CUBLAS}",
        ),
        ("Features : asimd", "aarch64", "0.10.2", "", CUBLAS),
        ("Features : asimd", "aarch64", "0.10.2", f"{TRITON_PRODUCTS}=true", f"{TRITON_PRODUCTS}=true"),
        ("flags : fma avx512f", "x86_64", "0.99.0", "", ""),  # a later jaxlib may not know the flag
    ],
    ids=[
        "none",
        "added",
        "chosen by the user",
        "bf16 units",
        "Arm",
        "a GPU's",
        "a later jaxlib",
    ],
)
def test_the_libraries_of_products_and_convolutions_are_chosen_unless_the_user_did(
    monkeypatch: pytest.MonkeyPatch, processor: str, machine: str, jaxlib: str, before: str, after: str
) -> None:
    monkeypatch.setattr(runtime, "_processor", lambda: processor)
    monkeypatch.setattr(runtime.platform, "machine", lambda: machine)
    monkeypatch.setattr(runtime, "version", lambda _: jaxlib)
    monkeypatch.setenv("XLA_FLAGS", before)
    set_xla_flags()
    assert os.environ["XLA_FLAGS"] == after


def test_programs_are_dropped_from_a_process_that_maps_too_much_memory() -> None:
    double = jax.jit(lambda x: 2 * x)
    double(1.0)
    assert not runtime.drop_compiled_programs(most=10**9)
    assert double._cache_size() == 1  # type: ignore[attr-defined]
    assert runtime.drop_compiled_programs(most=0)
    assert double._cache_size() == 0  # type: ignore[attr-defined]
