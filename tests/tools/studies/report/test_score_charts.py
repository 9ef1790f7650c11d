import re

import numpy as np

from rsjax.evaluation.registry import metrics
from rsjax.tools.studies.report.score_charts import frame_curves_svg, place_errors_svg, probes_svg

_METRICS = [metrics()[name] for name in ("psnr", "ssim", "cube_error_widths", "gripper_error_widths")]
_BASE = {"frame": [2, 3, 4]}


def _curve(name, values):
    return {name: values, f"{name}_low": [v and v - 1 for v in values], f"{name}_high": [v and v + 1 for v in values]}


def _lines(svg, color):
    """The y coordinates, downwards, of the lines of a colour."""
    found = re.findall(r'<path d="([^"]*)" clip-path="[^"]*" style="([^"]*)"', svg)
    points = [path for path, style in found if f"stroke: {color}" in style]
    return [[float(y) for y in re.findall(r"[ML] \S+ (\S+)", path)] for path in points]


def test_each_metric_with_a_curve_has_a_chart_with_a_line_for_each_scene():
    curves = _BASE | _curve("psnr", [27.0, 26.0, 24.0]) | _curve("psnr_tokenizer", [28.0, 28.0, 28.0])
    svg = frame_curves_svg(curves | _curve("ssim", [0.9, 0.8, 0.7]), _METRICS)
    assert svg.count(">PSNR, dB ↑<") == svg.count(">SSIM ↑<") == 1
    assert "widths" not in svg
    assert svg.count(">prediction<") == svg.count(">tokenizer's reconstruction<") == 1
    assert "first frame repeated" not in svg
    (psnr, _), (tokenizer,) = _lines(svg, "#3b7dd8"), _lines(svg, "#3f9a63")
    first, second = np.diff(psnr)
    assert first > 0
    np.testing.assert_allclose(second, 2 * first, rtol=1e-4)
    assert len(set(tokenizer)) == 1 and tokenizer[0] < min(psnr)


def test_frames_without_a_score_are_a_gap_and_no_curves_are_no_chart():
    whole, part = (frame_curves_svg(_BASE | _curve("psnr", [27.0, 26.0, last]), _METRICS) for last in (24.0, None))
    assert [len(_lines(svg, "#3b7dd8")[0]) for svg in (whole, part)] == [3, 2]
    assert frame_curves_svg(_BASE | _curve("unknown", [1.0, 2.0, 3.0]), _METRICS) == ""
    single = {"frame": [2], "psnr": [27.0], "psnr_low": [None], "psnr_high": [None]}
    assert "PSNR" in frame_curves_svg(single, _METRICS)


def test_errors_of_places_are_drawn_from_the_best_clip_to_the_worst():
    rng = np.random.default_rng(0)
    errors = rng.permutation(np.geomspace(0.02, 2.0, 20)).tolist()
    svg = place_errors_svg({"cube_error_widths": errors, "cube_error_widths_truth": [0.0] * 20}, _METRICS)
    assert svg.count(">cube's place, widths ↓<") == 1
    assert "gripper" not in svg
    (line,) = _lines(svg, "#3b7dd8")
    steps = np.diff(line)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-3)  # a straight line on a logarithmic scale
    assert steps[0] < 0
    assert place_errors_svg({"psnr": [20.0]}, _METRICS[2:]) == ""


def test_drives_have_their_own_frames_and_grasps_both_worlds():
    drives = [metrics()["drive_psnr"], metrics()["drive_gripper_error_widths"]]
    curves = _BASE | {"drive_frame": [2, 3, 4, 5], "contact_offset_cm": [0.0, 2.0]}
    curves |= _curve("drive_psnr", [27.0, 26.0, 24.0, 22.0]) | _curve("drive_psnr_repeat_first", [20.0] * 4)
    curves |= _curve("contact_simulator", [1.0, 0.5]) | _curve("contact_model", [1.0, 1.0])
    svg = probes_svg(curves, drives)
    assert svg.count(">PSNR of drives, dB ↑<") == svg.count(">first frame repeated<") == 1
    assert svg.count(">simulator<") == svg.count(">model<") == 1
    psnr, model = _lines(svg, "#3b7dd8")
    assert len(psnr) == 4
    assert len(set(model)) == 1
    assert probes_svg(_BASE, drives) == ""
