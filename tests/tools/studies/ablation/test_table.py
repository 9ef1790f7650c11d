import csv
import io
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from rsjax.evaluation.registry import metrics
from rsjax.tools.studies.ablation.figure import draw
from rsjax.tools.studies.ablation.sweep import runs_of
from rsjax.tools.studies.ablation.table import (
    Row,
    as_csv,
    as_json,
    as_markdown,
    best,
    shown_columns,
    tabulate,
)
from rsjax.tools.studies.results import RunResult, final_terms, spread
from tests.tools.studies.ablation import toy

COLUMNS = tuple(column for column in metrics().values() if column.column)
PSNR = metrics()["psnr"]
GRID = toy.grid("model.depth=branch,none", "model.loss.keypoints=printed,none", seeds=(0, 1, 2))
RUNS = list(runs_of(GRID, Path("out"), Path("data")).values())


def rows_of(metrics: Mapping[int, Mapping[str, float]], reasons: Mapping[int, dict[str, str]] = {}) -> list[Row]:
    """The table of cells of which these are finished with their metrics, and the others are not."""
    finished = {i: RunResult(RUNS[i], "finished", "", numbers, reasons.get(i, {})) for i, numbers in metrics.items()}
    results = (finished.get(i) or RunResult(run, "missing", "its reason", {}) for i, run in enumerate(RUNS))
    return tabulate(results, GRID.fields)


def full(rng: np.random.Generator) -> dict[int, dict[str, float]]:
    """Metrics of all cells; those without depth have no depth metrics."""
    return {
        i: {
            c.name: float(rng.normal())
            for c in COLUMNS
            if run.config.model.uses_depth or not c.name.startswith("depth")
        }
        for i, run in enumerate(RUNS)
    }


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=8))
def test_a_spread_is_mean_and_sample_deviation(values: list[float]) -> None:
    mean, std, n = spread(values)
    assert n == len(values)
    assert mean == pytest.approx(np.mean(values), abs=1e-6)
    if n == 1:
        assert std is None
    else:
        assert std == pytest.approx(np.sqrt(np.square(np.array(values) - np.mean(values)).sum() / (n - 1)), abs=1e-6)


def test_rows_gather_the_seeds_of_equal_values() -> None:
    metrics = full(np.random.default_rng(0))
    rows = rows_of(metrics)
    assert [tuple(row.values.values()) for row in rows] == [
        ("branch", "printed"),
        ("branch", "none"),
        ("none", "printed"),
        ("none", "none"),
    ]
    for number, row in enumerate(rows):
        seeds = [metrics[number + 4 * seed]["psnr"] for seed in range(3)]
        expected = (np.mean(seeds), np.std(seeds, ddof=1), 3)
        assert tuple(row.spreads["psnr"]) == pytest.approx(expected)
    assert "depth_absrel" not in rows[2].spreads


def test_the_best_mean_is_the_largest_or_smallest_as_the_metric_wants() -> None:
    metrics = full(np.random.default_rng(1))
    rows = rows_of(metrics)
    for column in COLUMNS:
        means = [row.spreads[column.name].mean if column.name in row.spreads else np.nan for row in rows]
        assert best(rows, column) == {int(np.nanargmax(means) if column.better == "higher" else np.nanargmin(means))}
        less = replace(column, decimals=-1)
        assert best(rows, less) == {i for i, mean in enumerate(means) if not np.isnan(mean)}, "all are shown as 0"
    assert best(rows[:1], PSNR) == set(), "nothing to compare with"
    same = rows_of({i: {"psnr": 1.0} for i in range(12)})
    assert best(same, PSNR) == {0, 1, 2, 3}
    broken = rows_of({i: {"psnr": float("nan") if i % 4 == 0 else i % 4} for i in range(12)})
    assert best(broken, PSNR) == {3}


def test_markdown_shows_means_spreads_counts_absences_and_the_best() -> None:
    metrics = {0: {"psnr": 20.0, "depth_absrel": 0.1}, 4: {"psnr": 21.0, "depth_absrel": 0.3}, 2: {"psnr": 22.0}}
    text = as_markdown(rows_of(metrics))
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    assert lines[0] == ["model.depth", "model.loss.keypoints", "seeds", "PSNR, dB ↑", "depth AbsRel ↓"]
    assert lines[2] == ["branch", "printed", "2/3", "20.50 ± 0.71", "0.2000 ± 0.1414"]
    assert lines[3] == ["branch", "none", "0/3", "–", "–"]
    assert lines[4] == ["none", "printed", "1/3", "**22.00**", "–"]
    assert len({len(line) for line in text.splitlines() if line.startswith("|")}) == 1
    assert text.count("- model.depth=") == 9
    assert "- model.depth=none,model.loss.keypoints=none,seed=2: missing (its reason)" in text


def test_an_absent_metric_has_its_reason_as_a_footnote() -> None:
    metrics = {0: {"psnr": 20.0, "lpips_alex": 0.1}, 4: {"psnr": 21.0}, 2: {"psnr": 22.0, "depth_absrel": 0.3}}
    weights = dict.fromkeys(("lpips_alex", "lpips_vgg", "depth_absrel_l1_scale_estimator"), "no weights")
    rows = rows_of(metrics, {0: {"depth_absrel": "no depth"}, 2: weights, 4: {"depth_absrel": "no depth"}})
    text = as_markdown(rows)
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    assert lines[0][3:] == ["PSNR, dB ↑", "LPIPS, AlexNet ↓", "LPIPS, VGG ↓", "depth AbsRel ↓"]
    assert lines[2][3:] == ["20.50 ± 0.71", "0.1000", "–", "–¹"]
    assert lines[3][3:] == ["–"] * 4, "not finished"
    assert lines[4][3:] == ["**22.00**", "–²", "–²", "0.3000"]
    assert "\n\n¹ no depth\n\n² no weights\n" in text
    assert [column.name for column in shown_columns(rows)] == ["psnr", "lpips_alex", "depth_absrel"]
    assert as_json(rows)["cells"][0]["reasons"] == {"depth_absrel": "no depth"}


def test_files_have_every_metric_at_full_precision() -> None:
    metrics = {i: m | {"psnr_low": -1.5} for i, m in full(np.random.default_rng(3)).items()}
    rows = rows_of(metrics)
    lines = list(csv.DictReader(io.StringIO(as_csv(rows))))
    saved = as_json(rows)
    assert "Not in the table" not in as_markdown(rows)
    for row, line, entry in zip(rows, lines, saved["rows"], strict=True):
        assert line["model.depth"] == str(row.values["model.depth"])
        assert entry["values"] == row.values
        for name, numbers in row.spreads.items():
            assert [float(line[f"{name}_{part}"]) for part in ("mean", "std", "n")] == list(numbers)
            assert entry[name] == {"mean": numbers.mean, "std": numbers.std, "n": numbers.n}
    assert lines[3]["depth_absrel_mean"] == "" and lines[3]["depth_absrel_n"] == "0"
    assert saved["best"]["psnr"] == sorted(best(rows, PSNR))
    assert [cell["metrics"] for cell in saved["cells"]] == [dict(r.metrics) for row in rows for r in row.results]


def test_the_picture_has_a_panel_per_metric_and_grows_with_the_rows() -> None:
    whole, part = rows_of(full(np.random.default_rng(4))), rows_of({0: {"psnr": 1.0}})
    sizes = []
    for rows in (whole, part, whole[:2], rows_of({})):
        with Image.open(io.BytesIO(draw(rows, shown_columns(rows), "a grid"))) as image:
            sizes.append(image.size)
    assert sizes[0][0] > sizes[1][0]
    assert sizes[0][1] > sizes[2][1]
    assert [len(shown_columns(rows)) for rows in (whole, part)] == [len(COLUMNS), 1]


@given(st.lists(st.floats(0, 10), min_size=1, max_size=40))
def test_a_loss_at_the_end_is_the_mean_of_its_last_tenth(values: list[float]) -> None:
    log = [{"step": i, "rgb": value} for i, value in enumerate(values)]
    count = max(1, round(len(values) / 10))
    assert final_terms(log, ("rgb", "depth")) == {"loss_rgb": pytest.approx(np.mean(values[-count:]))}
    assert final_terms([], ("rgb",)) == {}
