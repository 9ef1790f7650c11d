"""Judges saved rollouts of policies again, by people who judge blindly or by a vision-language model.

The simulator's rollouts are among them: comparing their verdicts with the simulator's own predicate shows how often the
judge is right.
"""

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from rsjax.artifact import make_once
from rsjax.config import content_key
from rsjax.errors import UserError
from rsjax.files import read_json
from rsjax.progress import Progress
from rsjax.tools.policies.judges.judge import FAIL, SUCCESS, UNINTERPRETABLE, Judge
from rsjax.tools.policies.judges.people_and_vlms import SHEET, HumanJudge, LanguageJudge, video_name, write_blinded
from rsjax.tools.policies.judges.validation import scores, summary
from rsjax.tools.policies.studies.policy_evaluation import compared, write_results
from rsjax.tools.policies.studies.trials import TrialResult, Trials

Rollouts = dict[str, list[UInt8[np.ndarray, "T S S 3"]]]  # by policy, one for each episode
EVERY = 20  # verdicts are saved after each this many videos


def blind(out: Path, folder: Path) -> Path:
    """Writes all rollouts of a comparison as videos for people to judge, and returns the sheet to fill in.

    Raises:
        UserError: ``out`` has no finished comparison, or the folder has a sheet already.
    """
    if (folder / SHEET).exists():
        raise UserError(f"{folder / SHEET}: exists; its labels would be lost, so name a new folder")
    worlds = _rollouts(out, _results(out)).values()
    return write_blinded([video for policies in worlds for videos in policies.values() for video in videos], folder)


def named_judge(words: str) -> tuple[Judge, str]:
    """Returns the judge that ``human:SHEET.csv`` or ``vlm:DIRECTORY`` names, and a name for its folder.

    Raises:
        UserError: the words name no judge, or its files are missing or damaged.
    """
    kind, _, place = words.partition(":")
    path = Path(place)
    if kind == "human" and place:
        return HumanJudge.read(path), f"human-{zlib.crc32(path.read_bytes()):08x}"
    if kind == "vlm" and place:
        judge = LanguageJudge.load(path)
        sizes = sorted((file.name, file.stat().st_size) for file in path.iterdir())
        return judge, f"vlm-{content_key(str(path.resolve()), str(sizes), judge.question, judge.frames)[:8]}"
    raise UserError(f"--judge-with {words}: it is human:SHEET.csv, a sheet that --blind wrote, or vlm:DIRECTORY")


def rejudge(out: Path, judge: Judge, name: str) -> Path:
    """Judges all rollouts of a comparison at their last frames, and writes the results that follow.

    Args:
        out: the folder of the comparison.
        judge: sees one whole video at a time.
        name: the end of the name of the judge's folder in ``out``, which also keeps the verdicts so far.

    Returns:
        The folder, with ``results.json``, ``results.md`` and ``scatter.png`` like the comparison's.

    Raises:
        UserError: ``out`` has no finished comparison, or the judge cannot judge one of its videos.
    """
    results = _results(out)
    folder = out / f"judged-{name}"
    rollouts = _rollouts(out, results)
    policies = results["runs"][0]["policies"]
    true = {name: TrialResult(each["simulator"], each["clipped"]["simulator"]) for name, each in policies.items()}
    verdicts = _verdicts(rollouts, judge, folder, name)
    truth = np.concatenate([np.where(each.success, SUCCESS, FAIL) for each in true.values()])
    checked = scores(np.concatenate([verdicts["simulator"][policy] for policy in true]), truth)
    rows = []
    for row in results["runs"]:
        labels = {policy: probabilities.argmax(-1) for policy, probabilities in verdicts[row["run"]].items()}
        made = {
            policy: TrialResult(
                (label == SUCCESS).tolist(),
                row["policies"][policy]["clipped"]["world_model"],
                (label == UNINTERPRETABLE).tolist(),
                row["policies"][policy]["unfamiliarity"],
            )
            for policy, label in labels.items()
        }
        training = {name: each["training"] for name, each in row["policies"].items()}
        judged = {"like": row["like"], "judge": summary({"raw": checked})}
        again = {name: each["replayed"] for name, each in row["policies"].items()}
        rows.append(compared(row["run"], true, made, again, training) | judged)
    write_results(folder, rows, Trials(**results["trials"]))
    return folder


def _results(out: Path) -> dict[str, Any]:
    file = out / "results.json"
    results: dict[str, Any] = read_json(file, cure="compare policies first: rsjax policy_evaluation RUN")
    return results


def _rollouts(out: Path, results: Mapping[str, Any]) -> dict[str, Rollouts]:
    """Returns the videos of the simulator and of each run."""
    worlds = ["simulator", *(row["run"] for row in results["runs"])]
    policies = results["runs"][0]["policies"]
    count = int(results["trials"]["episodes"])
    rollouts: dict[str, Rollouts] = {}
    for world in worlds:
        videos: Rollouts = {}
        for name in policies:
            videos[name] = []
            for number in range(count):
                file = out / world / name / f"episode-{number:02d}.npz"
                if not file.exists():
                    raise UserError(f"{file}: missing; compare the policies again in another --out")
                with np.load(file) as arrays:
                    videos[name].append(np.asarray(arrays["rgb"]))
        rollouts[world] = videos
    return rollouts


def _verdicts(
    rollouts: Mapping[str, Rollouts], judge: Judge, folder: Path, name: str
) -> dict[str, dict[str, Float[np.ndarray, "N 3"]]]:
    """Returns the judge's probabilities for every video; equal videos are judged once."""
    names = {
        world: {policy: [video_name(video) for video in videos] for policy, videos in policies.items()}
        for world, policies in rollouts.items()
    }
    videos = {video_name(video): video for world in rollouts.values() for some in world.values() for video in some}
    # Again, because the comparison may have more runs by now; verdicts on known videos are kept.
    with make_once(folder, content_key("judged", name), refuse=None, again=True) as work:
        known: dict[str, list[float]] = work.metadata.get("verdicts", {})
        with Progress("judging", len(videos), "videos", len(known)) as progress:
            for number, (video_id, video) in enumerate(videos.items(), 1):
                if video_id not in known:
                    known[video_id] = judge(video[None])[0].tolist()
                if number % EVERY == 0 or number == len(videos):
                    work.save(verdicts=known)
                progress.update(number)
    return {
        world: {policy: np.array([known[video_id] for video_id in some]) for policy, some in policies.items()}
        for world, policies in names.items()
    }
