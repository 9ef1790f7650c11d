"""Chooses a font of this machine that has the letters of a text, to draw the text on pictures."""

from collections.abc import Iterator
from functools import cache

from matplotlib import font_manager
from matplotlib.ft2font import FT2Font
from PIL import ImageFont

_DEFAULT = str(font_manager.findfont("DejaVu Sans"))  # comes with matplotlib


def font(size: int, text: str = "") -> ImageFont.FreeTypeFont:
    """Returns the font in which to draw a text: the first font with all its letters, else the one with most of them."""
    wanted = _letters(text)
    best = _DEFAULT
    for path in _fonts():
        if len(wanted & _has(path)) > len(wanted & _has(best)):
            best = path
        if wanted <= _has(best):
            break
    return ImageFont.truetype(best, size)


def lacks_letters(text: str) -> bool:
    """Returns whether no font of this machine has all letters of a text."""
    wanted = _letters(text)
    return not any(wanted <= _has(path) for path in _fonts())


def _letters(text: str) -> set[int]:
    return {ord(letter) for letter in text if not letter.isspace()}


def _fonts() -> Iterator[str]:
    yield _DEFAULT
    for entry in font_manager.fontManager.ttflist:
        if entry.style == "normal" and "LastResort" not in str(entry.fname).replace(" ", ""):  # it draws boxes
            yield str(entry.fname)


@cache
def _has(path: str) -> frozenset[int]:
    try:
        return frozenset(FT2Font(path).get_charmap())
    except (OSError, RuntimeError):  # it was removed, or is damaged
        return frozenset()
