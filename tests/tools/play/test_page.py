"""The page in a browser: a person drives, branches, rewinds, uploads and keeps, in both themes and on a phone."""

import io
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rsjax.tools.play.play_run import PlayRun
from rsjax.tools.studies.report.depth_view import depth_to_colors
from tests.tools.play.client import Server, serving
from tests.tools.play.fake import hub_of

api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed (make extras)")

Open = Callable[..., Any]
# The counter says "frame" before the first picture is drawn.
_READY = """() => { const canvas = document.querySelector('.layers canvas:first-child');
  return canvas?.width && canvas.getContext('2d').getImageData(0, 0, 1, 1).data[3] > 0
    && document.querySelector('.counter')?.textContent.startsWith('frame '); }"""
_LENGTH = "length => Number(document.querySelector('.transport input')?.max) >= length - 1"
_PIXELS = "() => [...document.querySelectorAll('.layers canvas:first-child')].map(each => each.toDataURL())"
_NAMELESS = """() => [...document.querySelectorAll('button, input, select')].filter(each => !(each.labels?.length
    || each.closest('[hidden]') || each.getAttribute('aria-label') || each.textContent.trim()))
    .map(each => each.outerHTML)"""
# The contrast of each text with what lies behind it, as WCAG defines it; colours are opaque except where there is none.
_CONTRAST = """() => {
  const parse = text => text.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map(c => c / 255)
    .map(c => c <= .03928 ? c / 12.92 : ((c + .055) / 1.055) ** 2.4)
    .reduce((sum, c, place) => sum + c * [.2126, .7152, .0722][place], 0);
  const behind = each => { for (let at = each; at; at = at.parentElement) {
    const color = parse(getComputedStyle(at).backgroundColor); if (color.length < 4 || color[3]) return color; } };
  const visible = each => each.checkVisibility() && !each.closest('.notes, .idle, [hidden], :disabled');
  return [...document.querySelectorAll('body *')].filter(each => visible(each)
    && [...each.childNodes].some(node => node.nodeType === 3 && node.textContent.trim())).map(each => {
      const [one, two] = [light(parse(getComputedStyle(each).color)), light(behind(each))];
      return [(Math.max(one, two) + .05) / (Math.min(one, two) + .05), each.textContent.trim().slice(0, 30)]; });
}"""


@pytest.fixture(scope="module")
def server(run: PlayRun) -> Iterator[Server]:
    with serving(hub_of(run, most=16)) as served:
        yield served


@pytest.fixture
def opened(browser: Any, server: Server) -> Iterator[Open]:
    """Opens the page and waits for its first frame; afterwards there must have been no error on it."""
    contexts: list[Any] = []
    problems: list[str] = []

    def open_page(
        width: int = 1280, scheme: str = "light", path: str = "/", at: Server = server, wait: bool = True
    ) -> Any:
        contexts.append(browser.new_context(viewport={"width": width, "height": 844}, color_scheme=scheme))
        page = contexts[-1].new_page()
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", lambda message: problems.extend([message.text] * (message.type == "error")))
        page.goto(f"http://127.0.0.1:{at.port}{path}")
        if wait:
            page.wait_for_function(_READY)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not [problem for problem in problems if "WebSocket" not in problem]  # Chromium logs refused connections


def _drive(page: Any, key: str, length: int) -> None:
    """Holds a key until the branch has so many frames, pressed again where the window lost the focus."""
    for _ in range(6):
        page.keyboard.down(key)
        with suppress(api.TimeoutError):
            page.wait_for_function(_LENGTH, arg=length, timeout=5000)
        page.keyboard.up(key)
        if page.evaluate(_LENGTH, length):
            break
    page.wait_for_function(
        "() => document.querySelector('.counter').textContent.match(/\\d+/g).every((n, _, all) => n === all[0])"
    )


def test_a_person_drives_rewinds_and_branches(opened: Open, tmp_path: Path) -> None:
    page = opened()
    assert "85 % succeed here" in page.inner_text("#measured")
    first = page.evaluate(_PIXELS)
    page.keyboard.press("r")  # however short
    page.wait_for_function(_LENGTH, arg=2)
    _drive(page, "w", 21)
    assert page.evaluate(_PIXELS) != first
    slider = page.get_by_role("slider", name="frame")
    page.keyboard.press("Home")
    assert slider.input_value() == "0"
    page.wait_for_function(f"first => ({_PIXELS})()[0] === first", arg=first[0])
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    _drive(page, "s", 9)
    page.wait_for_selector(".branches li:nth-child(2)")
    names = page.locator(".branch-name").all_inner_texts()
    assert [re.sub(r"\s+", " ", name) for name in names] == ["0 start", "1 from frame 6 of 0"]
    assert page.locator(".view").count() == 2, "the branch that was left is shown beside the new one"
    page.wait_for_function(f"() => new Set(({_PIXELS})()).size === 2")
    page.keyboard.press("Home")
    page.wait_for_function(f"() => new Set(({_PIXELS})()).size === 1")
    page.get_by_role("button", name="remove branch 1").click()
    page.wait_for_function("() => document.querySelectorAll('.branch').length === 1")
    page.wait_for_function("() => document.querySelector('#meter').dataset.keys > 0")
    assert re.search(r"key to picture\s+\d+ ms, 95 % within \d+ ms", page.inner_text("#meter"))
    page.screenshot(path=tmp_path / "driven.png")


def test_other_sources_play_on_and_a_step_makes_one_frame(opened: Open) -> None:
    page = opened()
    page.get_by_label("actions from").select_option("random")
    page.get_by_role("button", name="one frame on").click()
    page.wait_for_function(_LENGTH, arg=2)
    page.get_by_role("button", name="play").click()
    page.wait_for_function(_LENGTH, arg=8)
    page.get_by_role("button", name="pause").click()
    page.get_by_label("actions from").select_option("clip")
    page.get_by_role("button", name="play").click()
    page.wait_for_selector(".notes.error")  # the clip ends
    page.wait_for_selector("button[aria-label^=play]")


def test_a_picture_is_uploaded_and_the_page_says_how_it_was_cut(opened: Open, tmp_path: Path) -> None:
    Image.fromarray(np.full((90, 160, 3), 200, np.uint8)).save(tmp_path / "desk.png")
    (tmp_path / "notes.png").write_text("no picture")
    page = opened()
    page.keyboard.press("c")
    page.wait_for_selector(".clip img")
    page.set_input_files("#upload", tmp_path / "desk.png")
    page.wait_for_function("() => document.getElementById('start').textContent.includes('160 × 90')")
    _drive(page, "w", 3)
    page.keyboard.press("c")
    page.set_input_files("#upload", tmp_path / "notes.png")
    page.wait_for_selector(".notes.error")


def test_a_session_is_recorded_exported_and_linked(opened: Open, server: Server) -> None:
    page = opened()
    _drive(page, "d", 6)
    page.get_by_text("Keep", exact=True).click()
    for label, ending in (("Record this branch", ".mp4"), ("Export all branches as clips", ".zip")):
        with page.expect_download() as download:
            page.get_by_role("button", name=label).click()
        assert download.value.suggested_filename.endswith(ending)
        assert Path(download.value.path()).stat().st_size > 100
    page.get_by_role("button", name="Copy a link").click()
    page.wait_for_function("() => location.hash.startsWith('#state=')")
    other = opened(path="/" + page.evaluate("() => location.hash"))
    other.wait_for_function(_LENGTH, arg=6)
    length = page.locator(".transport input").get_attribute("max")
    for each in (page, other):
        each.keyboard.press("End")
        each.wait_for_function("max => document.querySelector('.transport input').value === max", arg=length)
    other.wait_for_function(f"pixels => ({_PIXELS})()[0] === pixels", arg=page.evaluate(_PIXELS)[0])
    for each in (page, other):  # a link that was made, and one that was loaded
        _drive(each, "d", int(length) + 3)
        sent: list[str] = []
        take = sent.append
        each.on("websocket", lambda socket, take=take: socket.on("framesent", lambda data: take(str(data))))
        each.reload()
        each.wait_for_function(_LENGTH, arg=int(length) + 3)
        _drive(each, "d", int(length) + 4)
        assert sent and not [text for text in sent if '"type":"load"' in text]


def test_without_a_clipboard_the_page_says_where_the_link_is(opened: Open) -> None:
    page = opened()
    page.evaluate("() => Object.defineProperty(navigator, 'clipboard', { value: undefined })")  # as over plain http
    page.get_by_text("Keep", exact=True).click()
    page.get_by_role("button", name="Copy a link").click()
    page.wait_for_function("() => document.getElementById('notes').textContent.includes('stands in the address bar')")


_SOCKETS = """async () => {
  const { connect } = await import('/page/connection.js');
  const pass = () => {};
  let opened = 0;
  const on = { open: () => opened++, message: pass, frame: pass, lost: pass, closed: pass };
  const connection = connect({ session: () => null, on });
  const early = await connection.upload(new Blob(['x'])).catch(({ code }) => code);
  connection.again();
  connection.again();
  await new Promise(done => setTimeout(done, 1500));
  return [early, opened];
}"""


def test_one_socket_is_open_at_a_time_and_refuses_an_upload_before_it_is(opened: Open) -> None:
    assert opened().evaluate(_SOCKETS) == ["lost", 1]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_the_page_is_legible_in_both_themes_and_on_a_phone(
    opened: Open, tmp_path: Path, scheme: str, width: int
) -> None:
    page = opened(width, scheme)
    page.get_by_role("slider", name="frame").focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_timeout(50)
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width
    assert page.evaluate(_NAMELESS) == []
    assert [each for each in page.evaluate(_CONTRAST) if each[0] < 4.5] == []
    dark = np.asarray(Image.open(io.BytesIO(page.screenshot(path=tmp_path / f"{scheme}-{width}.png"))).convert("L"))
    assert (np.median(dark) < 80) == (scheme == "dark")


def test_a_reload_returns_to_the_session_and_a_lost_connection_says_so(opened: Open, run: PlayRun) -> None:
    with serving(hub_of(run)) as small:
        page = opened(at=small)
        _drive(page, "a", 4)
        page.reload()
        page.wait_for_function(_LENGTH, arg=4)
    page.wait_for_selector("#banner:not([hidden])")
    assert "connection was lost" in page.inner_text("#banner span")


def test_a_full_server_and_a_freed_session_say_what_to_do(opened: Open, run: PlayRun) -> None:
    with serving(hub_of(run, most=1)) as small:
        opened(at=small)
        second = opened(at=small, wait=False)
        second.wait_for_selector("#banner:not([hidden])")
        assert second.inner_text("#banner span") and second.inner_text("#banner button") == "Try again"
    with serving(hub_of(run, idle=0.3)) as small:
        page = opened(at=small, wait=False)
        page.wait_for_selector("#banner:not([hidden])")
        assert "freed" in page.inner_text("#banner span")
        page.get_by_role("button", name="Start again").click()
        page.wait_for_selector("#banner", state="hidden")


def test_depth_has_the_reports_colours(opened: Open) -> None:
    colors = opened().evaluate("async () => (await import('/page/turbo.js')).depthColors(0.5, 3)")
    expected = depth_to_colors(np.linspace(0.5, 3, 256), 0.5, 3)
    assert np.abs(np.array(colors) - expected.astype(int)).max() <= 4  # of 255
