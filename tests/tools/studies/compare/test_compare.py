import csv
import io
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsjax.config import ConfigError
from rsjax.errors import UserError
from rsjax.evaluation.protocols import PROTOCOLS
from rsjax.evaluation.results import Result
from rsjax.evaluation.statistics import bootstrap, welch
from rsjax.tools.studies.compare.groups import noted, parse_group, read_groups
from rsjax.tools.studies.compare.page import ComparedClip, strips, write_page
from rsjax.tools.studies.compare.published import LOSSY, published_name, published_text
from rsjax.tools.studies.compare.table import as_csv, as_json, as_markdown, compare
from tests.tools.studies.compare import toy

Make = Callable[..., str]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Writes runs and returns their group as the command takes it."""

    def make(name: str, *results: Result) -> str:
        paths = [toy.run(tmp_path / f"{name},seed={i}", each) for i, each in enumerate(results)]
        return f"{name}={','.join(map(str, paths))}"

    return make


def test_one_seed_each_is_paired_by_clip(make: Make) -> None:
    a, b = toy.result(0.0), toy.result(0.4)
    found = compare(read_groups([make("a", a), make("b", b)], None))
    difference = found.differences["psnr"][1]
    assert difference is not None
    expected = bootstrap(np.array(b.per_clip["psnr"]) - np.array(a.per_clip["psnr"]))
    assert difference.interval is not None
    assert difference.interval.value == pytest.approx(expected.value)
    assert difference.interval.low == pytest.approx(expected.low)
    assert (difference.finding, difference.welch) == ("better", None)
    # Clips differ by far more than models do, so only pairing shows it.
    cells = [cell.interval for cell in found.scores["psnr"][:2]]
    assert cells[0] and cells[1] and cells[0].high is not None and cells[1].low is not None
    assert cells[0].high > cells[1].low
    assert [entry.name for entry in found.entries] == ["a", "b", "first frame repeated", "tokenizer's reconstruction"]
    findings = [each.finding if each else None for each in found.differences["psnr"]]
    assert findings == [None, "better", "worse", "better"]


def test_a_difference_is_better_only_where_seeds_agree(make: Make) -> None:
    a = [toy.result(gain, seed) for seed, gain in enumerate((-1.0, 0.0, 1.0))]
    b = [toy.result(gain, seed) for seed, gain in enumerate((0.5, 1.0, 1.5))]
    c = [toy.result(gain, seed) for seed, gain in enumerate((3.9, 4.0, 4.1))]
    found = compare(read_groups([make("a", *a), make("b", *b), make("c", *c)], "paper"))
    _, weak, strong, *_ = found.differences["psnr"]
    assert weak and strong and weak.welch and strong.welch
    seeds = np.array([[each.metrics["psnr"] for each in group] for group in (a, b)], float)
    expected = welch(seeds[1], seeds[0])
    assert expected
    assert weak.welch.p == pytest.approx(expected.p)
    assert weak.welch.p > 0.05
    assert (weak.finding, strong.finding) == ("cannot tell", "better")
    assert found.scores["psnr"][0].spread == pytest.approx((np.mean(seeds[0]), np.std(seeds[0], ddof=1), 3))
    other = compare(read_groups([make("a", *a), make("c", *c)], "paper"), against="c")
    assert [each.finding if each else None for each in other.differences["psnr"]][:2] == ["worse", None]
    same = found.differences["depth_absrel_median_branch"][1]
    assert same and same.finding == "same"


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"data": {"split": "unseen_task"}}, "data.split is test in the first, unseen_task in the other"),
        ({"data": {"fps": 10.0}}, "data.fps is 5.0 in the first, 10.0 in the other"),
        ({"settings": {"physics_iq_threshold": 20}}, "settings.physics_iq_threshold is 10 in the first, 20 in the"),
        ({"protocol": {"horizon": 48, "temperature": 1.0}}, "protocol.temperature is None in the first, 1.0 in"),
        ({"clips": [{"number": 0, "sha256": "0"}]}, "the scored clips differ in their content"),
    ],
)
def test_unlike_evaluations_are_refused_by_field(make: Make, changes: dict, says: str) -> None:
    plain = toy.result(0.0)
    merged = {
        name: getattr(plain, name) | value if isinstance(value, dict) else value for name, value in changes.items()
    }
    with pytest.raises(UserError, match=f"were not evaluated alike: .*{re.escape(says)}"):
        read_groups([make("a", plain), make("b", replace(plain, **merged))], None)
    unknown_rate = replace(plain, data=plain.data | {"fps": None})
    assert len(read_groups([make("c", plain), make("d", unknown_rate)], None)) == 2


def test_reconstructions_by_different_tokenizers_are_not_compared(make: Make) -> None:
    plain = toy.result(0.0)
    one = replace(plain, protocol=plain.protocol | {"reference": "reconstruction"})
    still = [score + 0.1 for score in plain.per_clip["psnr_repeat_first"]]
    other = replace(one, per_clip=plain.per_clip | {"psnr_repeat_first": still})
    assert len(read_groups([make("a", one), make("b", one)], None)) == 2
    with pytest.raises(UserError) as refused:
        read_groups([make("c", one), make("d", other)], None)
    assert "the tokenizers differ" in str(refused.value)


def test_seeds_that_do_not_vary_leave_a_json_file_that_can_be_read(make: Make) -> None:
    groups = [make(name, *(toy.result(gain, noise=0.0) for _ in range(2))) for name, gain in (("a", 0.0), ("b", 1.0))]
    found = compare(read_groups(groups, "paper"), ["psnr"])
    (row,) = [row for row in json.loads(json.dumps(as_json(found), allow_nan=False))["scores"] if row["entry"] == "b"]
    assert (row["t"], row["p"]) == (None, 0)


def test_files_have_published_numbers_apart_and_reasons(make: Make, tmp_path: Path) -> None:
    genie = toy.result(1.0, model={"run": "g", "family": "genie", "trained_on": "less"})
    found = compare(read_groups([make("ours", toy.result(0.0)), make("theirs", genie)], None))
    text = as_markdown(found)
    assert "published: RoboScape" in text
    assert "published: Genie" in text
    assert re.search(r"PSNR, dB ↑ .*\| 21.8533 +\| 19.7571 ", text)
    assert re.search(r"depth AbsRel, branch, median ↓ .*\| 0.36 +\| 0.4425 ", text)
    assert re.search(r"LPIPS.* ↓ +\| –¹ ", text)
    assert "¹ no weights" in text
    assert "model.trained_on is toy in the first, less in the other" in text
    rows = list(csv.DictReader(io.StringIO(as_csv(found))))
    kinds = {row["entry"]: row["kind"] for row in rows}
    assert kinds == {
        **dict.fromkeys(("ours", "theirs"), "group"),
        **dict.fromkeys(("first frame repeated", "tokenizer's reconstruction"), "baseline"),
        **dict.fromkeys(("RoboScape", "Genie"), "published"),
    }
    assert json.loads(json.dumps(as_json(found)))["groups"]["theirs"][0]["model"]["trained_on"] == "less"
    write_page(tmp_path / "page.html", found, "the command")
    page = (tmp_path / "page.html").read_text()
    assert page.count("data:image/webp") == len(strips(found)) >= 6
    assert "published" in page
    assert 'class="met">better' in page


def with_model(made: Result, family: str) -> Result:
    return replace(made, model=made.model | {"family": family, "run": family})


def test_bair_has_the_authors_numbers_beside_the_best_of_100_samples(make: Make) -> None:
    best = {"psnr_best100_incl_ctx": 24.0, "lpips_vgg_best100_incl_ctx": 0.06, "psnr": 20.0, "lpips_vgg": 0.2}
    ours = replace(
        toy.result(0.0),
        label="ivideogpt-bair",
        protocol=PROTOCOLS["ivideogpt-bair"].described(),
        metrics=dict(best),
        per_clip={name: [value] * toy.CLIPS for name, value in best.items()},
    )
    groups = [make(name, with_model(ours, name)) for name in ("roboscape", "ivideogpt")]
    text = as_markdown(compare(read_groups(groups, "ivideogpt-bair")))
    assert re.search(r"PSNR, best of 100.*\| 26.4 +\| 24.5 ", text)
    assert re.search(r"LPIPS, VGG.*, best of 100.*\| 0.0321 +\| 0.05 ", text)
    assert re.search(r"\| PSNR, dB ↑ .*\| – +\| – ", text)
    assert "on BAIR with iVideoGPT's protocol" in text


def test_unseen_scenes_have_a_published_row_for_each_family_of_that_table(make: Make) -> None:
    families = ("roboscape", "genie", "irasim", "cogvideox")
    unseen = replace(toy.result(0.0), label="unseen,unseen_camera", protocol=PROTOCOLS["unseen"].described())
    groups = [make(name, with_model(unseen, name)) for name in families]
    text = as_markdown(compare(read_groups(groups, "unseen,unseen_camera")))
    assert re.search(r"PSNR, dB ↑ .*\| 23.4049 +\| 21.6537 +\| 11.9085 +\| 18.5676 ", text)
    assert re.search(r"depth AbsRel, branch, median ↓ .*\| 0.2552 +\| 0.3259 +\| 0.6063 +\| 0.4577 ", text)


def row_of(clip: ComparedClip) -> int:
    return int(re.findall(r"\d+", clip.title)[0]) // 2


def test_grasps_and_drives_are_compared_with_their_curves(make: Make, tmp_path: Path) -> None:
    def probed(gain: float, lies: list[float]) -> Result:
        plain = toy.result(gain)
        curves: dict[str, list[float | None]] = {
            "contact_offset_cm": [0.0, 2.0, 4.0],
            "contact_simulator": [1.0, 0.5, 0.0],
            "contact_model": [1.0, 1.0, 1.0],
        }
        curves |= {"drive_frame": [2.0, 3.0], "drive_psnr": [20.0 + gain, 18.0 + gain]}
        scores: dict[str, float | None] = {"contact_false_success": float(np.mean(lies)), "drive_psnr": 19.0 + gain}
        per_clip = {"contact_false_success": lies, "drive_psnr": [18.0 + gain, 20.0 + gain]}
        return replace(
            plain,
            metrics=plain.metrics | scores,
            per_clip=plain.per_clip | per_clip,
            curves=plain.curves | curves,
        )

    found = compare(read_groups([make("a", probed(0.0, [1.0] * 9)), make("b", probed(1.0, [0.0] * 9))], None))
    assert [each.finding for each in found.differences["contact_false_success"] if each] == ["better"]
    assert "lifted where the simulator fails ↓" in as_markdown(found)
    write_page(tmp_path / "page.html", found, "the command")
    page = (tmp_path / "page.html").read_text()
    charts = page[page.index("<svg") : page.index("</svg>")]
    assert charts.count(">share of grasps that succeed<") == 1
    assert charts.count(">PSNR of drives, dB ↑<") == 1


def test_strips_show_the_ends_of_all_clips_and_of_the_kept_ones(make: Make) -> None:
    plain = toy.result(0.0)
    result = replace(plain, per_clip=plain.per_clip | {"psnr": (10.0 + 7 * np.arange(toy.CLIPS) % 40).tolist()})
    found = compare(read_groups([make("a", result), make("b", toy.result(1.0))], None))
    psnr, still = (np.array(result.per_clip[name]) for name in ("psnr", "psnr_repeat_first"))
    most, least = np.argsort(still)[:3], np.argsort(-still)[:3]
    kept = toy.ROWS[np.argsort(psnr[toy.ROWS])]
    shown = {row_of(clip): clip for clip in strips(found)}
    assert list(shown) == list(dict.fromkeys([*most, *least, *kept[:3], *kept[:-4:-1]]))
    assert f"moves most (1 of all 40 clips; first frame repeated: {still[most[0]]:.2f} dB" in shown[most[0]].title
    assert (kept[0], kept[-1]) == (0, 28), "neither moves most or least"
    for row in kept[[0, -1]]:
        assert f" of the {len(toy.ROWS)} kept clips; a: {psnr[row]:.2f} dB" in shown[row].title
    for row, clip in shown.items():
        place = np.flatnonzero(row == toy.ROWS)[0]
        labels, rows = zip(*clip.rows(), strict=True)
        assert labels == ("truth", "a", "b", "first frame\nrepeated", "tokenizer's\nreconstruction")
        np.testing.assert_array_equal(rows[1], 255 - toy.TRUTH[place])
        np.testing.assert_array_equal(rows[3][-1], toy.TRUTH[place, 0])


def test_metrics_are_chosen_by_pattern(make: Make) -> None:
    groups = read_groups([make("a", toy.result(0.0))], None)
    assert [each.name for each in compare(groups, ["ps*", "fvd"]).metrics] == ["psnr", "fvd"]
    with pytest.raises(ConfigError, match="--only psnrr: no metric of these results; did you mean 'psnr'"):
        compare(groups, ["psnrr"])
    with pytest.raises(ConfigError, match="--against b: no such group"):
        compare(groups, against="b")


def test_parts_of_metrics_are_compared_beside_their_baselines(make: Make) -> None:
    plain = toy.result(0.0)
    names = "delta_psnr delta_psnr_t4 psnr_second_half physics_iq_mse physics_iq_mse_all_frames psnr_n1_pred_only"
    scores = dict.fromkeys([*names.split(), "psnr_tokenizer_second_half", "psnr_second_half_low", "clips"], 1.0)
    groups = read_groups([make("a", replace(plain, metrics={**plain.metrics, **scores}))], None)
    only = ["delta_*", "*_all_frames", "psnr_second_half", "*_n1_pred_only"]
    found = compare(groups, only)
    wanted = ["delta_psnr", "delta_psnr_t4", "psnr_second_half", "physics_iq_mse_all_frames", "psnr_n1_pred_only"]
    assert [each.name for each in found.metrics] == wanted
    assert [each.title for each in found.metrics][1:3] == ["ΔPSNR, another clip's actions, t4", "PSNR, second half"]
    assert [cell.spread and cell.spread.mean for cell in found.scores["psnr_second_half"]] == [1.0, None, 1.0]
    rows = {row["metric"]: row["mean"] for row in as_json(found)["scores"] if row["entry"] == "RoboScape"}
    assert rows == {"delta_psnr": 3.3435, "physics_iq_mse_all_frames": 0.0184}
    assert {*(each.name for each in compare(groups).metrics)}.isdisjoint({"delta_psnr_t4", "psnr_second_half"})
    whole = "psnr_low psnr_repeat_first success_share nothing"
    for name in whole.split():
        with pytest.raises(ConfigError, match="no metric of these results"):
            compare(groups, [name])


def test_differences_of_medians_are_those_of_the_scores_beside_them(make: Make) -> None:
    def result(seed: int, scale: float) -> Result:
        plain, errors = toy.result(0.0, seed), scale * np.random.default_rng(seed).exponential(size=toy.CLIPS)
        score, per_clip = {"cube_error_widths": float(np.median(errors))}, {"cube_error_widths": errors.tolist()}
        return replace(plain, metrics={**plain.metrics, **score}, per_clip=plain.per_clip | per_clip)

    groups = [make("a", result(0, 1.0), result(1, 2.0)), make("b", result(2, 1.0), result(3, 3.0))]
    found = compare(read_groups(groups, None), ["cube_error_widths", "psnr"])
    a, b = (cell for cell in found.scores["cube_error_widths"][:2])
    change = found.differences["cube_error_widths"][1]
    assert a.spread and b.spread and a.interval and change and change.interval and change.welch
    assert a.interval.value == pytest.approx(a.spread.mean)
    assert change.interval.value == pytest.approx(b.spread.mean - a.spread.mean)
    assert change.welch.difference.value == pytest.approx(change.interval.value)
    assert re.search(r"median over clips, not its mean: [^;]*cube[^;]*\.", as_markdown(found))


def test_groups_are_paths_lists_or_patterns_with_commas_in_names(tmp_path: Path) -> None:
    for name in ("x=1,seed=0", "x=1,seed=1", "plain"):
        (tmp_path / name).mkdir()
    first, second = tmp_path / "x=1,seed=0", tmp_path / "x=1,seed=1"
    assert parse_group(str(first)) == (first.name, (first,))
    assert parse_group(f"full={first},{tmp_path / 'plain'},{second}") == ("full", (first, tmp_path / "plain", second))
    assert parse_group(f"full={tmp_path}/x=1,*") == ("full", (first, second))
    for text, says in (
        ("nowhere", "no run directory; write RUN"),
        (f"a={tmp_path}/plain,{tmp_path}/none", "no run directory '.*none'"),
        (f"a={first},{first}", "is named twice"),
    ):
        with pytest.raises(ConfigError, match=says):
            parse_group(text)


def test_a_missing_result_names_the_command(make: Make, tmp_path: Path) -> None:
    (tmp_path / "bare").mkdir()
    both = make("both", toy.result(0.0))
    toy.run(tmp_path / "both,seed=0", replace(toy.result(0.0), label="horizon48"))
    toy.run(tmp_path / "b", replace(toy.result(0.0), label="unseen,unseen_camera"))
    for group, protocol, message in (
        (make("a", toy.result(0.0)), "papr", "no result of protocol papr; did you mean 'paper'.*rsjax evaluate"),
        (f"{tmp_path}/bare", None, "no protocol has evaluated all of them; rsjax evaluate"),
        (both, None, "results of horizon48 and of paper; choose one with --protocol"),
        (f"{tmp_path}/b", "unseen", "no result unseen, but unseen,unseen_camera; choose one of them with --proto"),
    ):
        with pytest.raises(UserError, match=message):
            read_groups([group], protocol)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"family": "genie"}, "model.family is roboscape in the first, genie in the other"),
        ({"settings": {"loss": {"gamma": 9.0}}}, "model.settings.loss.gamma is 5.0 in the first, 9.0 in the other"),
        ({"training": {"train": {"steps": 9}}}, "model.training.train.steps is 5 in the first, 9 in the other"),
        ({"weights_sha256": "w0"}, "have the same weights; a group takes each training once"),
        (
            {"settings": {"loss": {"gamma": 5.0}, "whole_frames": False, "heads": {"weight": 1.0}}},
            "model.settings.heads.weight is not set in the first, 1.0 in the other",
        ),
        ({"seed": 1, "settings": {"loss": {"gamma": 5.0}, "whole_frames": False, "unroll": 4}}, ""),
    ],
)
def test_runs_of_a_group_differ_in_their_seed_alone(make: Make, changes: dict, says: str) -> None:
    plain = toy.result(0.0)
    own = plain.model | {
        "preset": "tiny",
        "settings": {"loss": {"gamma": 5.0}, "whole_frames": False, "unroll": 1},
        "weights_sha256": "w0",
    }
    own |= {"training": {"train": {"steps": 5}}}
    group = make("a", replace(plain, model=own), replace(plain, model=own | {"weights_sha256": "w1"} | changes))
    if not says:
        assert len(read_groups([group], None)[0].results) == 2
        return
    with pytest.raises(UserError, match=f"a: runs/0.0 and runs/0.0 .*{re.escape(says)}"):
        read_groups([group], None)


@pytest.mark.parametrize("reads", [False, True])
def test_a_setting_of_sampling_is_noted_only_where_it_differs(make: Make, reads: bool) -> None:
    plain = toy.result(0.0, sampling={"steps": 2, "read_means": False})
    other = toy.result(1.0, sampling={"steps": 2, "read_means": reads})
    notes = noted(read_groups([make("a", plain), make("b", other)], None))
    line = "a and b: sampling.read_means is False in the first, True in the other"
    assert notes == ([line] if reads else [])


def test_rows_of_the_paper() -> None:
    rows = {"branch": "RoboScape", "none": "RoboScape w/o depth", "head": None}
    for kind, row in rows.items():
        settings = {"depth": {"kind": kind}, "loss": {"keypoints": "printed"}}
        assert published_name({"family": "roboscape", "settings": settings}) == row
    assert published_name({"family": "irasim"}) == "IRASim"
    assert published_name({"family": "irasim", "settings": {"autoencoder": {"depth": "none"}}}) == "IRASim"
    assert published_name({"family": "irasim", "settings": {"autoencoder": {"depth": "inverse"}}}) is None
    assert published_name({"family": "mine"}) is None


def test_published_physics_iq_says_what_lossy_video_does_to_it() -> None:
    assert published_text("psnr", 21.8533) == "21.8533"
    for name, size in LOSSY.items():
        assert published_text(f"{name}_all_frames", 0.5) == f"0.5 (lossy video: ± {size:g})"
