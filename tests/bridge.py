"""The path of real episodes (25 of BridgeData V2), which lie next to some checkouts, and a mark for their tests."""

from pathlib import Path

import pytest

BRIDGE = Path(__file__).parents[2] / "shared" / "data" / "bridge"
needs_bridge = pytest.mark.skipif(not BRIDGE.exists(), reason=f"no real episodes at {BRIDGE}")
