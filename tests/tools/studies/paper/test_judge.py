"""Verdicts on scores with planted differences, and files of results, which give the same verdicts."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rsjax.config import presets
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies import result_pages
from rsjax.tools.studies.paper import result_files
from rsjax.tools.studies.paper.arm_scores import ArmScores, ScoreRows, key_of_test_clips, rounded
from rsjax.tools.studies.paper.claim import ArmComparison
from rsjax.tools.studies.paper.claim_tables import claim_content, claim_tables
from rsjax.tools.studies.paper.judge import Outcome, judge_claim, trials
from rsjax.tools.studies.tables import as_markdown
from tests.tools.studies.paper import toy

SEEDS = 5
CLIPS = 60
OWN = tuple(f"clips {seed}" for seed in range(SEEDS))


def arm(
    name: str, gain: float = 0.0, noise: float = 0.05, clips: tuple[str, ...] = (), more: Mapping[str, float] = {}
) -> ArmScores:
    """Scores of clips that differ by 3 dB, of seeds that differ by ``noise``, and ``gain`` dB more for this arm.

    Args:
        clips: the clips of each seed; those of each have another difficulty. Empty: all seeds have the same.
        more: further scores by name, with their gains.
    """
    keys = clips or ("the same",) * SEEDS
    rng = np.random.default_rng(len(name))
    found = {}
    for metric, added in {"psnr": gain, **more}.items():
        rows = []
        for key in keys:
            shared = np.random.default_rng(list(key.encode()))
            difficulty = shared.normal(20, 3, CLIPS) + shared.normal(0, 2)
            row = difficulty + added + rng.normal(0, noise) + rng.normal(0, noise, CLIPS)
            rows.append(tuple(rounded(float(value), 4) or 0.0 for value in row))
        found[metric] = ScoreRows(tuple(rows))
    numbers = {metric: [float(np.mean(row)) for row in scored.rows] for metric, scored in found.items()}
    seeds = tuple(map(OWN.index, clips)) or tuple(range(len(keys)))
    return ArmScores(name, SEEDS, seeds, tuple(f"{name} {seed}" for seed in seeds), keys, numbers, {"": found})


def outcome(*comparisons: ArmComparison, **arms: ArmScores) -> Outcome:
    claim = toy.claim("toy", *comparisons)
    return judge_claim(claim, [arms["with_"], arms["without"]])


def judged(*metrics: str, equal: float | None = None, **arms: ArmScores) -> list[str]:
    comparisons = [ArmComparison(metric, "with", "without", equal=equal) for metric in metrics]
    return [each.verdict for each in outcome(*comparisons, **arms).judged]


@pytest.mark.parametrize(
    ("gain", "noise", "verdict"),
    [
        (0.5, 0.05, "holds"),
        (-0.5, 0.05, "does not hold"),
        (0.0, 0.02, "equal"),
        (0.0, 0.5, "cannot tell"),
        (0.06, 0.004, "holds"),  # also within the margin of 0.1 dB, but a difference that is told is one
    ],
)
@pytest.mark.parametrize("clips", [(), OWN], ids=["the same clips", "clips of each seed"])
def test_a_planted_difference_is_found(gain: float, noise: float, verdict: str, clips: tuple[str, ...]) -> None:
    """Where each seed has its own clips, seeds differ by 2 dB: only pairs of seeds can tell 0.5 dB."""
    arms = {"with_": arm("with", gain, noise, clips), "without": arm("without", 0, noise, clips)}
    result = outcome(ArmComparison("psnr", "with", "without"), **arms)
    (found,) = result.judged
    assert found.verdict == verdict
    words = claim_content(result)["comparisons"][0]["verdict"]
    assert words == ("equal within 0.1 dB" if verdict == "equal" else verdict)
    assert found.difference is not None and found.resampled is not None and found.test is not None
    low = min(found.resampled.low or 0, found.test.difference.low or 0)
    assert found.difference.low == low, "the interval that is shown decides"


def test_trials_that_all_seeds_share_count_once() -> None:
    row = np.array([1.0, 0.0])
    assert len(trials([row, row, row], own_clips=False)) == 2
    assert len(trials([row, row, row], own_clips=True)) == 6
    assert len(trials([row, row, 1 - row], own_clips=False)) == 6


def test_seeds_of_one_arm_alone_have_no_pair() -> None:
    arms = {"with_": arm("with", 0.5, clips=OWN[:3]), "without": arm("without", clips=OWN[1:])}
    (found,) = outcome(ArmComparison("psnr", "with", "without"), **arms).judged
    assert found.verdict == "holds" and found.test is not None and found.test.df == 1
    apart = {"with_": arm("with", 0.5, clips=OWN[:2]), "without": arm("without", clips=OWN[2:])}
    (found,) = outcome(ArmComparison("psnr", "with", "without"), **apart).judged
    assert found.difference is None and "no clip has a score" in found.reason


def test_runs_on_clips_of_two_recipes_have_the_same_test_clips() -> None:
    config = presets.get("tiny")
    mixed = replace(config, sim=replace(config.sim, recipe=("expert=0.5", "grasps=0.5")))
    other = replace(config, sim=replace(config.sim, seed=1))
    keys = [key_of_test_clips(Run(each, Path("run"), Path("data"))) for each in (config, mixed, other)]
    assert keys[0] == keys[1] != keys[2]


def test_a_difference_that_holds_alone_may_not_among_several() -> None:
    """Chance decides a comparison of 20 wrongly; Holm's method keeps it from that."""
    names = [f"chance_{number}" for number in range(19)]
    arms = {
        "with_": arm("with", 0.04, 0.05, more=dict.fromkeys(names, 0.0)),
        "without": arm("without", 0, 0.05, more=dict.fromkeys(names, 0.0)),
    }
    assert judged("psnr", equal=0, **arms) == ["holds"]
    alone = outcome(ArmComparison("psnr", "with", "without"), **arms).judged[0]
    among = outcome(*(ArmComparison(name, "with", "without", equal=0) for name in ("psnr", *names)), **arms).judged[0]
    assert alone.test == among.test and alone.p is not None and among.p is not None
    assert among.p == pytest.approx(min(1, 20 * alone.p))
    assert among.verdict == "cannot tell"


def test_equal_sides_speak_against_the_claim_that_one_is_better() -> None:
    arms = {"with_": arm("with", 0.5, 0.02, more={"ssim": 0.0}), "without": arm("without", 0, 0.02, more={"ssim": 0.0})}
    both = [ArmComparison("psnr", "with", "without"), ArmComparison("ssim", "with", "without", equal=0.1)]
    assert outcome(*both, **arms).verdict == "does not hold"
    assert outcome(both[1], **arms).verdict == "equal"
    assert outcome(both[0], **arms).verdict == "holds"


def tables(found: Outcome) -> dict[str, str]:
    return {name: as_markdown(table) for name, table in claim_tables(claim_content(found)).items()}


@pytest.mark.parametrize("most", [result_files.MOST_BYTES, 0], ids=["json", "npz beside it"])
@pytest.mark.parametrize("clips", [(), OWN], ids=["the same clips", "clips of each seed"])
def test_a_file_gives_the_tables_of_the_scores_that_it_was_written_from(
    tmp_path: Path, most: int, clips: tuple[str, ...]
) -> None:
    with_ = arm("with", 0.5, clips=clips, more={"ssim": 0.1})
    odd = ((float("nan"), *with_.scores[""]["ssim"].rows[0][1:]), *with_.scores[""]["ssim"].rows[1:])
    with_ = replace(with_, steps=430, scores={"": {**with_.scores[""], "ssim": ScoreRows(odd)}})
    lacking = {"48 frames": {"psnr": ScoreRows(reason="no 48 frames yet")}}
    without = arm("without", clips=clips, more={"ssim": 0.0})
    comparisons = [*(ArmComparison(name, "with", "without") for name in ("psnr", "ssim"))]
    comparisons.append(ArmComparison("psnr", "with", "without", measurement="48 frames"))
    arms = {each.name: replace(each, scores=dict(each.scores) | lacking) for each in (with_, without)}
    found = judge_claim(toy.claim("toy", *comparisons), list(arms.values()))
    path = tmp_path / "toy.json"
    result_files.write_claim_result(path, found, {"command": "the command"}, most)
    assert path.with_suffix(".npz").exists() == (most == 0)
    read = result_files.read_claim_result(path)
    assert tables(read) == tables(found)
    assert [each.p for each in read.judged] == [each.p for each in found.judged]
    assert read.judged[1].clips == CLIPS - 1 and read.judged[2].reason == "with: no 48 frames yet"


def test_the_table_of_arms_has_what_an_estimator_reads_from_the_true_frames() -> None:
    """Its own error, from which the others are to be read."""
    name = "depth_absrel_exact_estimator"
    arms = [arm(each, more={name: 0.0, f"{name}_tokenizer": 1.0, f"{name}_truth": 2.0}) for each in ("with", "without")]
    found = judge_claim(replace(toy.claim(), shown=(name,)), arms)
    rows = [row for row in tables(found)["arms"].splitlines() if "*true frames" in row or "*tokenizer's" in row]
    assert len(rows) == 2 and all(row.count("*–*") == 1 for row in rows), "PSNR of true frames has no meaning"


def some_seeds(whole: ArmScores, rows: slice) -> ArmScores:
    """An arm with some of its finished seeds."""
    scores = {name: ScoreRows(scored.rows[rows]) for name, scored in whole.scores[""].items()}
    numbers = {name: values[rows] for name, values in whole.numbers.items()}
    parts = {name: getattr(whole, name)[rows] for name in ("seeds", "trainings", "clips")}
    return replace(whole, planned=len(parts["seeds"]), numbers=numbers, scores={"": scores}, **parts)


@pytest.mark.parametrize("clips", [(), OWN], ids=["the same clips", "clips of each seed"])
def test_seeds_of_two_machines_are_judged_as_those_of_one(tmp_path: Path, clips: tuple[str, ...]) -> None:
    arms = [replace(arm(name, gain, clips=clips), steps=430) for name, gain in (("with", 0.5), ("without", 0.0))]
    claim = toy.claim("toy", ArmComparison("psnr", "with", "without"))
    sizes = {"command": "the command", "preset": "tiny", "budget": "1 h", "sizes": {"episodes": 9}}

    def written(name: str, *, date: str = "2026-01-02", rows: slice = slice(None), **more: Any) -> Path:
        path = tmp_path / f"{name}.json"
        found = judge_claim(claim, [some_seeds(each, rows) for each in arms])
        about = {**sizes, "commits": [name], "machines": ["2 cores"], "dates": date, **more}
        result_files.write_claim_result(path, found, about)
        return path

    ours = written("ours", rows=slice(2))
    theirs = written("theirs", rows=slice(1, None), date="2026-01-01 to 2026-01-03")
    result_files.merge_claim_result(ours, theirs)
    assert tables(result_files.read_claim_result(ours)) == tables(judge_claim(claim, arms))
    assert "commit ours, theirs; 2 cores; 2026-01-01 to 2026-01-03" in result_files.about_result(ours)
    nothing_yet = written("nothing", rows=slice(0))
    result_files.merge_claim_result(nothing_yet, theirs)
    assert result_files.read_claim_result(nothing_yet).arms[0].seeds == arms[0].seeds[1:]
    before = ours.read_bytes()
    differing: dict[str, dict[str, Any]] = {
        "sizes of trainings": {"sizes": {"episodes": 10}},
        "presets": {"preset": "multitask"},
    }
    for what, other in differing.items():
        with pytest.raises(result_files.FileError) as error:
            result_files.merge_claim_result(ours, written("other", **other))
        assert f"its {what} differ" in str(error.value) and ours.read_bytes() == before
    (tmp_path / "printed.json").write_text('{"kind": "transcribed", "tables": {}}')
    with pytest.raises(result_files.FileError):
        result_files.merge_claim_result(tmp_path / "printed.json", theirs)


def test_seeds_that_share_their_clips_do_not_join_others(tmp_path: Path) -> None:
    files = []
    for name, clips, rows in (("ours", (), slice(3)), ("theirs", OWN, slice(3, None))):
        arms = [some_seeds(arm(each, clips=clips), rows) for each in ("with", "without")]
        files.append(tmp_path / f"{name}.json")
        found = judge_claim(toy.claim("toy", ArmComparison("psnr", "with", "without")), arms)
        about = {"command": "c", "preset": "tiny", "budget": "1 h", "sizes": {}, "commits": [], "machines": []}
        result_files.write_claim_result(files[-1], found, about | {"dates": "2026-01-01"})
    with pytest.raises(result_files.FileError) as refused:
        result_files.merge_claim_result(*files)
    assert "(--vary)" in str(refused.value)


def test_a_damaged_file_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "toy.json"
    path.write_text('{"arms": [], "claim": {"name": "toy"}}')
    with pytest.raises(result_files.FileError) as error:
        result_files.read_claim_result(path)
    assert "damaged or of another version" in str(error.value)


def test_a_study_becomes_a_file_a_table_and_a_figure(tmp_path: Path) -> None:
    study = tmp_path / "study"
    (study / "results").mkdir(parents=True)
    found = outcome(ArmComparison("psnr", "with", "without"), with_=arm("with", 0.5), without=arm("without"))
    about = result_files.provenance([])
    result_files.write_claim_result(study / "results" / "toy.json", found, about)
    root = tmp_path / "root"
    folder = root / result_pages.FOLDER
    (root / result_pages.DATA).mkdir(parents=True)
    (root / "README.md").write_text("")
    page = folder / "page.md"
    page.write_text("<!-- table mine comparisons -->\n<!-- end -->\n\n![seeds](mine.png)\n")
    result_pages.add_result(root, study, "toy", "mine")
    assert len(list(result_pages.differences(root))) == 2
    assert result_pages.write_pages(root) == [page, folder / "mine.png"]
    assert list(result_pages.differences(root)) == []
    text = page.read_text()
    assert "| with − without |" in text and "equal steps of the world model" in text
    with Image.open(folder / "mine.png") as image:
        assert image.width > 200
    result_files.write_claim_result(
        study / "results" / "toy.json", judge_claim(found.claim, [arm("with", 0.4), arm("without")]), about
    )
    result_pages.add_result(root, study, "toy", "mine")
    assert any("figure was not drawn" in line for line in result_pages.differences(root))
    with pytest.raises(result_pages.UserError) as error:
        result_pages.add_result(root, study, "tyo")
    assert "did you mean 'toy'?" in str(error.value)
