"""The script that installs compilers for absent accelerators, with a Python that does nothing."""

import subprocess
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "scripts" / "accelerators.sh"
PYTHON = """#!/bin/bash
case $* in
  "-m venv"*) mkdir -p "${!#}/bin" && cp "$0" "${!#}/bin/python" ;;
  "-c "*) dirname "$0" ;;
esac
"""


def installed(base: Path) -> bool:
    """Runs the script; returns whether it has installed anything."""
    done = subprocess.run([SCRIPT, base], check=True, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    return "installing" in done.stdout


def test_an_environment_that_was_moved_is_made_again(tmp_path: Path) -> None:
    base = tmp_path / "venv"
    (base / "bin").mkdir(parents=True)
    (base / "bin" / "python").write_text(PYTHON)
    (base / "bin" / "python").chmod(0o755)
    assert installed(base) and not installed(base)
    assert installed(base.rename(tmp_path / "moved"))
