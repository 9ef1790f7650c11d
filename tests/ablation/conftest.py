from tests.pipeline.conftest import command, debug, shared

__all__ = ["command", "debug", "shared"]
