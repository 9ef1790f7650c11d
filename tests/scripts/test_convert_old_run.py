"""The script that upgrades the settings of old runs."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rsjax.config import Config, from_dict, presets
from rsjax.config.config_fields import with_values

SCRIPT = Path(__file__).parents[2] / "scripts" / "convert_old_run.py"
OLD_RUNS = Path(__file__).with_name("old_runs")


@pytest.mark.parametrize(
    ("name", "preset"),
    [
        ("before_departures", "roboscape_tiny"),
        ("before_sections", "roboscape_tiny"),
        ("before_sections_full_size", "roboscape_s"),
        ("before_sections_irasim", "irasim_tiny"),
    ],
)
def test_an_old_run_is_upgraded_once_and_its_old_settings_are_kept(name: str, preset: str, tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    before = (OLD_RUNS / f"{name}.json").read_text()
    path.write_text(before)
    for _ in range(2):
        subprocess.run([sys.executable, str(SCRIPT), str(tmp_path)], check=True)
        upgraded = from_dict(Config, json.loads(path.read_text()))
        kept: dict[str, Any] = {}
        if preset == "roboscape_s":
            kept["model.sample.cache_dtype"] = "float32"  # the preset has bf16 now
        own = replace(presets.get(preset), name=json.loads(before)["name"])
        assert upgraded == with_values(own, kept)
        assert (tmp_path / "config.old.json").read_text() == before
