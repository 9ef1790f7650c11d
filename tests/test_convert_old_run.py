"""The script that upgrades the settings of old runs."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from rsjax.config import Config, RoboScapeConfig, from_dict, presets, to_dict

SCRIPT = Path(__file__).parents[1] / "scripts" / "convert_old_run.py"


def old(config: Config) -> dict[str, Any]:
    """The settings as they were stored before the restructuring."""
    values = to_dict(config)
    runtime, departures = values.pop("runtime"), values["model"].pop("departures")
    for section in ("tokenizer_train", "train"):
        values[section] |= runtime | {"skip_budget": 10, "keep_last": 2, "restarts": []}
        optimizer = values[section]["optimizer"]
        optimizer["beta1"], optimizer["beta2"] = optimizer.pop("betas")
    sizes = dict.fromkeys(("frames", "image_size", "tracks", "action_dim", "test_clips"), 0)
    values["data"] = {"store": "", "key": "", **sizes}
    model = values["model"]
    model["positions"] = "rotary" if departures.pop("rotary") else "learned"
    model["mask"]["visible_prefix"] = departures.pop("visible_prefix")
    model["mask"]["own_frames"] = departures.pop("self_conditioning")
    model["mask"]["own_frames_after"] = departures.pop("self_conditioning_after")
    model["loss"]["keypoint_target"] = "observed" if departures.pop("observed_anchor") else "predicted"
    model["loss"]["keypoint_masked_only"] = departures.pop("masked_keypoints")
    assert departures.pop("visible_keypoints"), "as all old models"
    model |= departures
    return values


def test_an_old_run_is_upgraded_once_and_its_old_settings_are_kept(tmp_path: Path) -> None:
    tiny = presets.tiny()
    assert isinstance(tiny.model, RoboScapeConfig)
    path = tmp_path / "config.json"
    before = json.dumps(old(tiny))
    path.write_text(before)
    for _ in range(2):
        subprocess.run([sys.executable, str(SCRIPT), str(tmp_path)], check=True)
        assert from_dict(Config, json.loads(path.read_text())) == tiny
        assert (tmp_path / "config.old.json").read_text() == before
