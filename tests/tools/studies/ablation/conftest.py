from tests.tools.pipeline.conftest import command, debug, shared

__all__ = ["command", "debug", "shared"]
