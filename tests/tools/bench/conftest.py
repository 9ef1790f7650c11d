import pytest


@pytest.fixture(autouse=True)
def without_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """PyTorch's training step is not compiled, which takes minutes; tests of it name another backend."""
    monkeypatch.setattr("rsjax.tools.bench.torch_part.COMPILER", "none")
