"""The player's data, and the player itself in a browser, from a file."""

import base64
import io

import numpy as np
import pytest
from PIL import Image

from rsjax.evaluation.metrics.psnr import psnr
from rsjax.tools.studies.report.page import RunReport, write_report
from rsjax.tools.studies.report.player import player_clip, player_script
from rsjax.tools.studies.report.video import sprite_uri


def _tile(uri, number, size):
    with Image.open(io.BytesIO(base64.b64decode(uri.split(",", 1)[1]))) as image:
        sheet = np.asarray(image.convert("RGB"))
    row, column = divmod(number, sheet.shape[1] // size)
    return sheet[row * size : (row + 1) * size, column * size : (column + 1) * size]


@pytest.mark.parametrize(("count", "sides"), [(2, (1, 2)), (7, (3, 3))])
def test_a_sprite_holds_each_frame_once(count, sides):
    frames = np.random.default_rng(0).integers(0, 256, (count, 1, 1, 3), np.uint8).repeat(16, 1).repeat(16, 2)
    uri = sprite_uri(frames)
    for t in range(count):
        np.testing.assert_allclose(_tile(uri, t, 16)[4:12, 4:12].mean((0, 1)), frames[t, 0, 0], atol=12)
    with Image.open(io.BytesIO(base64.b64decode(uri.split(",", 1)[1]))) as image:
        assert image.size == (16 * sides[1], 16 * sides[0])


def test_a_clip_of_the_player_has_its_rows_in_order_and_its_scores(make_clip):
    clip = make_clip(prompt_frames=2, label="typical")
    data = player_clip(clip)
    names = [row["label"] for row in data["rows"]]
    other = "prediction with another's actions"
    assert names == ["truth", "prediction", "tokenizer's reconstruction", "true depth", "predicted depth", other]
    assert [names[row] for row in np.argsort([row["narrow"] for row in data["rows"]])][:4] == [
        "truth",
        "prediction",
        "true depth",
        "predicted depth",
    ]
    scores = {line["name"]: line["values"] for line in data["psnr"]}
    assert set(scores) == {"prediction", "tokenizer's reconstruction", other}
    assert scores["prediction"][:2] == [None, None]
    np.testing.assert_allclose(scores["prediction"][2:], psnr(clip.truth, clip.prediction)[2:], atol=0.01)
    assert (data["depth"]["near"], data["depth"]["far"]) == ("1 m", "2 m")
    without_unit = player_clip(make_clip(depth_unit="relative"))["depth"]
    assert (without_unit["near"], without_unit["far"]) == ("1", "2 (no unit)")
    assert data["prompt"] == 2
    bare = player_clip(make_clip(true_depth=None, predicted_depth=None))
    assert bare["depth"] is None and bare["label"] == bare["title"] == "episode <7>"


def test_the_script_has_no_imports_left():
    script = player_script()
    assert "import " not in script and "export " not in script
    assert script.count("function makeGallery(") == script.count("function makeTransport(") == 1


_PIXEL = "all => all.map(each => [...each.getContext('2d').getImageData(8, 12, 1, 1).data].slice(0, 3))"


def test_the_player_scrubs_all_videos_in_step(tmp_path, make_clip, browser):
    pytest.importorskip("playwright")
    clips = [make_clip(frames=8, title=f"clip <{n}>", label=f"label {n}") for n in range(2)]
    clips[1] = make_clip(frames=5, truth=255 - clips[1].truth[:5], title="second", label="second")
    write_report(tmp_path / "report.html", RunReport("tiny", {}, clips=clips))
    page = browser.new_page(viewport={"width": 390, "height": 844}, reduced_motion="reduce")
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("request", lambda request: problems.append(request.url) if request.url.startswith("http") else None)
    page.goto(f"file://{tmp_path / 'report.html'}")
    page.wait_for_selector(".cells canvas")
    canvases, slider = page.locator(".cells canvas"), page.get_by_role("slider", name="frame")
    assert canvases.count() == 6 and "frame 1 of 8, prompt" in page.inner_text(".counter")
    for frame, press in ((1, "ArrowRight"), (7, "End"), (6, "ArrowLeft"), (0, "Home")):
        page.locator(".choice").first.focus()
        page.keyboard.press(press)
        assert slider.input_value() == str(frame)
        pixels = np.array(canvases.evaluate_all(_PIXEL))
        np.testing.assert_allclose(
            pixels[:2], [clips[0].truth[frame, 12, 8], clips[0].prediction[frame, 12, 8]], atol=30
        )
    page.get_by_role("button", name="play").click()
    page.wait_for_function("document.querySelector('.transport input').value > 1")
    page.get_by_role("button", name="pause").click()
    page.get_by_role("button", name="second").click()
    page.wait_for_function("document.querySelector('.counter').textContent.includes('of 5')")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert not problems
    page.close()
