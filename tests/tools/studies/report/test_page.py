import re
from html.parser import HTMLParser

import pytest

from rsjax.tools.studies.report.curves import curves_svg
from rsjax.tools.studies.report.page import RunReport, write_report
from rsjax.tools.studies.report.targets import judge

_METRICS = {
    "psnr": 26.314,
    "psnr_low": 25.4,
    "psnr_high": 27.2,
    "psnr_repeat_first": 19.8,
    "psnr_tokenizer": 28.7,
    "ssim": 0.8714,
    "delta_psnr": 6.75,
    "delta_psnr_uniform_t4": 4.125,
    "physics_iq_mse": 0.0123,
    "physics_iq_mse_tokenizer": 0.0045,
    "depth_absrel": 0.0213,
    "depth_absrel_repeat_first": 0.0555,
    "cube_error_widths": 0.251,
    "cube_error_widths_truth": 0.084,
    "gripper_error_widths": 0.312,
    "lifted_accuracy": 0.93,
    "seconds_total": 1633.0,
    "success_share": 0.4567,
}
_LOG = [{"step": s, "loss": 5.0 / (s + 1), "accuracy": s / 10, "note": "text"} for s in range(5)]
_CURVES = {
    "frame": [2, 3, 4],
    "psnr": [27.0, 26.0, None],
    "psnr_low": [26.0, 25.0, None],
    "psnr_high": [28.0, 27.0, None],
    "unknown": [1.0, 2.0, 3.0],
}
_VOID = {"meta", "img", "link", "br", "hr", "input"}


class _Page(HTMLParser):
    """Checks that tags nest; collects text, table rows and everything that an element would load."""

    def __init__(self, path):
        super().__init__()
        self.open, self.loads, self.images, self.cells, self.text = [], [], [], [], ""
        self.tags = set()
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        if tag not in _VOID:
            self.open.append(tag)
        if tag == "tr":
            self.cells.append([])
        for name, value in attrs:
            if name == "src" and tag == "img":
                self.images.append(value)
            elif name in ("src", "href", "xlink:href", "srcset", "data", "action", "poster"):
                self.loads.append(value)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in _VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data
        if "tr" in self.open and data.strip():
            self.cells[-1].append(data.strip())


@pytest.fixture(scope="module")
def full_page(tmp_path_factory, make_clip):
    path = tmp_path_factory.mktemp("report") / "report.html"
    report = RunReport(
        preset="tiny",
        metrics=_METRICS,
        clips=[make_clip(title=f"episode <{i}>") for i in range(3)],
        curves=_CURVES,
        per_clip={
            "ghost": [0.1, 0.3, 0.9],
            "ghost_tokenizer": [0.1, 0.3, 0.0],
            "cube_error_widths": [0.3, 0.0, 2.0],
            "cube_error_widths_truth": [0.1, 0.1, 0.1],
        },
        logs={"tokenizer": _LOG, "world model": _LOG},
        config={"name": "tiny", "train": {"learning_rate": 0.0001}},
        versions={"jax": "0.10.2"},
        seconds={"collect": 75.0, "train": 3725.0},
        command="python -m experiments.train tiny",
    )
    write_report(path, report)
    return path


def test_a_full_page_stands_alone(full_page):
    page = _Page(full_page)
    assert len(page.images) == 3 * 2  # filmstrip and keypoints of each clip
    assert all(uri.startswith("data:image/") for uri in page.images)
    assert all(uri.startswith("#") for uri in page.loads)
    assert not page.tags & {"link", "iframe", "object"}
    html = full_page.read_text()
    assert "<script" in html and not re.search(r"<script[^>]* src|^(import|export) |\bfetch\(", html, re.MULTILINE)
    assert not re.search(r"(@import|url\()\s*['\"]?http", html)
    assert html.index('id="gallery"') < html.index("<table")
    assert [p.name for p in full_page.parent.iterdir()] == ["report.html"]


def test_tables_show_each_number_in_its_row(full_page):
    page = _Page(full_page)
    header = ["test clips", "PSNR, dB ↑", "SSIM ↑", "depth AbsRel ↓", "ΔPSNR, another clip's actions, dB ↑"]
    assert header in page.cells
    assert ["prediction", "26.31", "25.40 – 27.20", "0.871", "0.0213", "6.75"] in page.cells
    assert ["first frame repeated", "19.80", "–", "0.0555", "–"] in page.cells
    assert ["tokenizer's reconstruction", "28.70", "–", "–", "–"] in page.cells
    assert ["test clips", "Physics-IQ MSE ↓"] in page.cells
    assert ["tokenizer's reconstruction", "0.0045"] in page.cells
    assert ["uniform random actions", "4.12"] in page.cells
    assert ["last frame", "cube's place, widths ↓", "gripper's place, widths ↓", "lifted or not ↑"] in page.cells
    assert ["prediction", "0.251", "0.312", "0.930"] in page.cells
    assert ["true frames (the reading network's own error)", "0.084", "–", "–"] in page.cells
    assert ["ΔPSNR, another clip's actions", "≥ 7 dB", "6.75 dB", "missed by 0.25"] in page.cells
    assert ["cube's place in the last frame, median error", "≤ 0.3 widths", "0.25 widths", "met"] in page.cells
    assert ["ghosts, share above 0.25", "2 of 3", "–", "1 of 3"] in page.cells
    assert not any(cells[0].startswith("morphing") for cells in page.cells if cells)
    assert ["train", "1 h 02 min"] in page.cells
    assert ["collect", "1 min 15 s"] in page.cells
    assert ["learning_rate", "0.0001"] in page.cells
    assert ["success_share", "0.4567"] in page.cells
    assert "python -m experiments.train tiny" in page.text
    assert "episode <0>" in page.text


def test_a_model_that_is_worse_than_the_first_frame_is_called_so_in_the_pages_first_line(tmp_path):
    worse = {"psnr": 18.0, "psnr_repeat_first": 19.8, "psnr_motion": 11.0, "psnr_motion_repeat_first": 12.0}
    write_report(tmp_path / "r.html", RunReport("debug", worse))
    body = (tmp_path / "r.html").read_text().partition("<body>")[2]
    first = re.sub(r"<[^>]*>", "", body).strip().partition("\n")[0]
    assert first.startswith("Worse than repeating the first frame, also where it moves (PSNR 18.0 dB")


def test_an_absent_metric_has_its_reason_as_a_footnote(tmp_path):
    weights = dict.fromkeys(("lpips_alex", "depth_absrel_median_estimator"), "no <weights>")
    report = RunReport(
        "tiny", _METRICS | {"depth_absrel_median_branch": 0.0123}, weights | {"depth_delta1": "no depth"}
    )
    write_report(tmp_path / "r.html", report)
    page = _Page(tmp_path / "r.html")
    assert ["prediction", "26.31", "25.40 – 27.20", "0.871", "–¹", "0.0213", "–²", "–¹", "6.75"] in page.cells
    assert ["predicted depth, median scale", "0.0123", "–²"] in page.cells
    assert ["estimator, median scale", "–¹", "–²"] in page.cells
    assert "¹ no <weights>." in page.text and "² no depth." in page.text


def test_grasps_and_drives_have_tables_and_curves_of_their_own(tmp_path):
    curves = {"drive_frame": [2, 3], "contact_offset_cm": [0.0, 2.0]}
    for name in ("drive_psnr", "contact_simulator", "contact_model"):
        curves |= {name: [0.9, 0.5], f"{name}_low": [0.8, 0.4], f"{name}_high": [1.0, 0.6]}
    scores = {"contact_false_success": 0.85, "contact_false_success_truth": 0.02, "contact_judge_accuracy": 0.976}
    scores |= {"drive_psnr": 14.5, "drive_psnr_repeat_first": 15.0}
    write_report(tmp_path / "r.html", RunReport("tiny", _METRICS | scores, curves=_CURVES | curves))
    page = _Page(tmp_path / "r.html")
    assert ["grasps", "lifted where the simulator fails ↓"] in page.cells
    assert ["prediction", "0.850"] in page.cells
    assert ["true frames (the reading network's own error)", "0.020"] in page.cells
    assert ["drives", "PSNR of drives, dB ↑"] in page.cells
    assert ["first frame repeated", "15.00"] in page.cells
    assert "in 98 % of the simulator's" in " ".join(page.text.split())
    assert page.text.count("PSNR of drives, dB ↑") == 2  # its table and its curve


def test_missing_parts_are_left_out(tmp_path, make_clip):
    write_report(tmp_path / "bare.html", RunReport(preset="debug", metrics={"psnr": 20.0}))
    page = _Page(tmp_path / "bare.html")
    assert ["test clips", "PSNR, dB ↑"] in page.cells
    assert "script" not in page.tags
    for absent in (
        "Targets",
        "Keypoints",
        "Training",
        "Clip by clip",
        "ΔPSNR",
        "Command",
        "Frame by",
        "Where cube",
        "Grasps",
    ):
        assert absent not in page.text
    clip = make_clip(true_depth=None, predicted_depth=None, tracks=None, visible=None, selected=None)
    write_report(tmp_path / "rgb.html", RunReport(preset="debug", metrics={}, clips=[clip]))
    page = _Page(tmp_path / "rgb.html")
    assert len(page.images) == 1
    for absent in ("Depth", "Keypoints", "Scores", "Details"):
        assert absent not in page.text


def test_a_failed_page_leaves_the_old_one(tmp_path, make_clip):
    path = tmp_path / "r.html"
    path.write_text("old")
    with pytest.raises(ValueError, match="log of tokenizer has no scalar"):
        write_report(path, RunReport(preset="tiny", metrics={}, logs={"tokenizer": [{"step": 1}]}))
    assert path.read_text() == "old"


def test_only_measured_targets_are_judged():
    verdicts = {v.target.name: v for v in judge(_METRICS)}
    assert len(verdicts) == 8
    assert [v.margin >= 0 for v in verdicts.values()] == [True, True, True, False, True, False, False, True]
    assert verdicts["prediction below the tokenizer's reconstruction"].margin == pytest.approx(3 - (28.7 - 26.314))
    late = judge({"psnr_tokenizer_second_half": 28.0, "psnr_second_half": 23.5})
    assert [(v.target.name, v.margin) for v in late] == [("the same, second half of the predicted frames", -0.5)]
    assert verdicts["whole run"].measured == pytest.approx(1633 / 60)
    assert [v.target.name for v in judge({"delta_psnr": 7.0})] == ["ΔPSNR, another clip's actions"]
    assert judge({"delta_psnr": 7.0})[0].margin == 0


def test_curves_draw_each_scalar_once_in_the_pages_colour():
    svg = curves_svg([*_LOG, {"step": 5, "loss": float("nan")}], "a & b")
    assert svg.startswith("<svg viewBox=")
    assert "a &amp; b curves" in svg
    assert "currentColor" in svg
    assert svg.count(">loss: nan<") == 1
    assert svg.count(">accuracy: 0.4<") == 1
    assert "note" not in svg
    assert "step:" not in svg
