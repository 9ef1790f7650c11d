"""Upgrades the config.json of runs that were trained before the settings were restructured.

``python scripts/convert_old_run.py runs/*``. A file that is up to date stays as it is; the old one is kept as
config.old.json. Stages of the run get new keys, so that ``experiments.train`` asks for --overwrite; generating and
evaluating work as before.
"""

import json
import sys
from pathlib import Path
from typing import Any

SHARED = ("log_every", "checkpoint_every", "eval_every", "sharding", "fsdp", "workers", "max_damaged", "wandb", "profile")
DROPPED = ("skip_budget", "keep_last", "keep_every", "keep_best", "restarts")
OWN_FRAMES = {"own_frames": "own_frames", "own_frames_after": "own_frames_after"}


def upgraded(config: dict[str, Any]) -> dict[str, Any]:
    """Returns the configuration with today's fields."""
    if "runtime" in config:
        return config
    config["runtime"] = {name: config["train"][name] for name in SHARED if name in config["train"]}
    for section in ("tokenizer_train", "train"):
        train = config[section]
        for name in (*SHARED, *DROPPED):
            train.pop(name, None)
        optimizer = train["optimizer"]
        optimizer["betas"] = [optimizer.pop("beta1"), optimizer.pop("beta2")]
        optimizer.pop("decay_share", None)
    return config


def main() -> None:
    """Upgrades every run directory of the command line."""
    for directory in map(Path, sys.argv[1:]):
        path = directory / "config.json"
        text = path.read_text()
        config = upgraded(json.loads(text))
        new = json.dumps(config, indent=1) + "\n"
        if json.loads(text) == config:
            print(f"{path}: up to date")
            continue
        (directory / "config.old.json").write_text(text)
        path.write_text(new)
        print(f"{path}: upgraded")


if __name__ == "__main__":
    main()
