"""Measures the page of a run in a browser: ``python -m benchmarks.play.latency runs/tiny --data-dir data``.

Arguments after the run go to ``experiments.play``. A headless Chromium on the same machine holds a key that moves the
arm and takes another every 0.4 s, for half a minute; the figures are those that the page itself shows.
"""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SECONDS = 30.0
HOLD = 0.4  # seconds of a key
KEYS = "wasdrf"
VIEWS = {"picture": (), "and depth": ("depth",), "and simulator": ("depth", "truth")}


@contextmanager
def server(arguments: list[str]) -> Iterator[str]:
    """Starts ``experiments.play``; yields its address."""
    command = [sys.executable, "-m", "experiments.play", *arguments, "--port", "0", "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = next((line for line in process.stdout if line.startswith("http")), None)
        if line is None:
            raise SystemExit(process.wait())
        yield line.split()[0]
    finally:
        process.terminate()
        process.wait()


def measure(browser: Any, address: str, shown: tuple[str, ...]) -> dict[str, str]:
    """Returns what the page shows below its pictures after half a minute."""
    page = browser.new_page()
    view = {name: name in shown for name in ("depth", "truth", "points", "uncertainty", "smooth")}
    page.add_init_script(f"localStorage.setItem('rsjax-view', '{str(view).lower().replace(chr(39), chr(34))}')")
    page.goto(address)
    page.wait_for_function("() => document.querySelector('.counter')?.textContent.startsWith('frame ')")
    drive(page, 3.0)  # what is compiled on the way does not count
    page.evaluate("() => document.dispatchEvent(new Event('rsjax-forget'))")
    drive(page, SECONDS)
    found: dict[str, str] = page.evaluate(
        "() => Object.fromEntries([...document.querySelectorAll('#meter dd')].map(each => "
        "[each.dataset.value, each.textContent]))"
    )
    page.close()
    return found


def drive(page: Any, seconds: float) -> None:
    """Holds one key after the other."""
    end = time.monotonic() + seconds
    number = 0
    page.keyboard.down(KEYS[0])
    while time.monotonic() < end:
        page.wait_for_timeout(1000 * HOLD)
        before = KEYS[number]
        number = (number + 1) % len(KEYS)
        page.keyboard.down(KEYS[number])
        page.keyboard.up(before)
    page.wait_for_timeout(600)  # the page writes its figures twice a second
    page.keyboard.up(KEYS[number])


def main() -> None:
    """Prints a line for each choice of views."""
    from playwright.sync_api import sync_playwright

    path = os.environ.get("CHROMIUM") or shutil.which("chromium")
    with server(sys.argv[1:]) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        for name, shown in VIEWS.items():
            found = measure(browser, address, shown)
            print(
                f"{name:<14} {found['rate']} frames/s, key to picture {found['key']}, server {found['server']}",
                flush=True,
            )
        browser.close()


if __name__ == "__main__":
    main()
