from rsjax.evaluation.statistics import Estimate
from rsjax.tools.studies.results import spread
from rsjax.tools.studies.tables import Footnotes, Marked, Table, as_csv, as_html, as_markdown, interval_text, mean_text

TABLE = Table(["", "a|b"], [["one", Marked("1", "best")], [Marked("two", "note"), Marked("<2>", "met", "& more")]])


def test_markdown_is_aligned_and_shows_marks_and_remarks() -> None:
    assert as_markdown(TABLE).splitlines() == [
        "|       | a\\|b        |",
        "| ----- | ----------- |",
        "| one   | **1**       |",
        "| *two* | <2>: & more |",
    ]


def test_html_escapes_texts_and_has_a_class_for_each_mark() -> None:
    html = as_html(TABLE)
    assert "<thead><tr><th></th><th>a|b</th></tr></thead>" in html
    assert '<tr><td>one</td><td class="best">1</td></tr>' in html
    assert '<td class="note">two</td><td class="met">&lt;2&gt;<small>&amp; more</small></td>' in html
    assert as_html(Table(["x"], [["1"], ["2"]], first_bold=True)).count('<tr class="first">') == 1


def test_numbers_are_texts_with_the_decimals_of_their_metric() -> None:
    assert mean_text(spread([1.0, 2.0]), 2) == "1.50 ± 0.71"
    assert mean_text(spread([1.0]), 1) == "1.0"
    assert mean_text(spread([1.0]), 1, 1) == "1.0"
    assert mean_text(spread([1.0]), 1, 3) == "1.0 (1 of 3 seeds)"
    assert interval_text(Estimate(1.0, 0.5, 1.5), 1) == "[0.5, 1.5]"
    assert interval_text(Estimate(1.0, None, None), 1) == interval_text(None, 1) == ""
    assert as_csv(["x", "y"], [[0.1, None]]) == "x,y\n0.1,\n"


def test_equal_reasons_share_a_footnote() -> None:
    notes = Footnotes()
    marks = [notes.absent(reason) for reason in ("no depth", None, "no weights", "no depth")]
    assert marks == ["–¹", "–", "–²", "–¹"]
    assert notes.texts == ["¹ no depth", "² no weights"]
