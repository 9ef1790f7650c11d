"""Rollouts of toy policies, judged again by a sheet of labels."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsjax.errors import UserError
from rsjax.tools.policies.judges.judge import LABELS
from rsjax.tools.policies.judges.people_and_vlms import video_name
from rsjax.tools.policies.studies.policy_evaluation import compare
from rsjax.tools.policies.studies.rejudging import blind, named_judge, rejudge
from rsjax.tools.policies.studies.trials import Trials
from tests.tools.policies.toy_worlds import ToyPolicy, imagined, judge, simulated


def test_a_sheet_of_labels_decides_on_the_rollouts_that_were_kept(tmp_path: Path) -> None:
    policies: Any = {"slow": ToyPolicy(0.8), "fast": ToyPolicy(1.0)}
    out, trials = tmp_path / "out", Trials(episodes=5, max_steps=4, together=5, videos=1)
    models: Any = {"run": lambda: imagined(5, pace=0.9)}
    first = compare(policies, simulated(5), models, trials, out, training={"slow": "a", "fast": "b"})
    (tmp_path / "blind").mkdir()  # as an interrupted call leaves it
    sheet = blind(out, tmp_path / "blind")
    with pytest.raises(UserError, match="exists; its labels would be lost"):
        blind(out, tmp_path / "blind")
    videos = {video_name(rgb): rgb for rgb in (np.load(file)["rgb"] for file in out.rglob("episode-*.npz"))}
    assert {f"{name}," for name in videos} == set(sheet.read_text().splitlines()[1:])

    labels = {name: LABELS[int(judge(rgb[None])[0].argmax())] for name, rgb in videos.items()}
    assert (
        rejudged(out, sheet, labels)["runs"][0] | {"judge": None} == first["runs"][0]
    )  # one who sees as the judge does
    seen = np.load(out / "run" / "fast" / "episode-00.npz")["rgb"]
    labels[video_name(seen)] = "uninterpretable"
    (row,) = rejudged(out, sheet, labels)["runs"]
    assert row["policies"]["fast"]["uninterpretable"] == [True, False, False, False, False]
    assert row["judge"]["raw"]["right"][0] == 1 and np.sum(row["judge"]["raw"]["confusion"]) == 10
    assert "| raw |" in next(out.glob("judged-human-*/results.md")).read_text().replace("  ", "")

    del labels[video_name(seen)]
    with pytest.raises(UserError, match="has no label of 1 of 1 videos"):
        rejudged(out, sheet, labels)
    next(out.glob("run/slow/episode-03.npz")).unlink()
    with pytest.raises(UserError, match=r"episode-03.npz: missing; compare the policies again in another --out"):
        rejudged(out, sheet, labels)


def rejudged(out: Path, sheet: Path, labels: dict[str, str]) -> dict[str, Any]:
    sheet.write_text("\n".join(["video,label", *(f"{name},{label}" for name, label in labels.items())]))
    found: dict[str, Any] = json.loads((rejudge(out, *named_judge(f"human:{sheet}")) / "results.json").read_text())
    return found


def test_judges_that_do_not_exist_are_named(tmp_path: Path) -> None:
    for words in ("human", "people:a.csv", "vlm:"):
        with pytest.raises(UserError, match=r"it is human:SHEET.csv, a sheet that --blind wrote, or vlm:DIRECTORY"):
            named_judge(words)
    with pytest.raises(UserError, match="compare policies first"):
        blind(tmp_path, tmp_path / "blind")
