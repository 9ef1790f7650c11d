"""Lets the tests of this folder call commands in their own process."""

import pytest


@pytest.fixture(autouse=True)
def no_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keeps ``tune_process`` from restarting the process, which is pytest, for huge pages."""
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.hugetlb=1")
