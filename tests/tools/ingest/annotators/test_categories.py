import csv
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.config import ConfigError
from rsjax.tools.ingest.annotators import categories
from rsjax.tools.ingest.annotators.categories import CategoryConfig, parse_table

CONFIG = CategoryConfig(parse_table("--difficulty", ("*fold*=difficult", "pick*=simple")), (("*kitchen*", "home"),))

SOFT = ("fold", "iron", "flatten", "curtain", "tablecloth", "dough", "rope")


@pytest.mark.parametrize(
    ("task", "word"),
    [("Pick the cup", "simple"), ("pick and fold it", "difficult"), ("wipe", "unknown"), ("", "unknown")],
)
def test_the_first_pattern_that_matches_counts_in_any_case(task: str, word: str) -> None:
    assert CONFIG.difficulty(task) == word


def test_the_task_counts_before_the_parts_text_and_that_before_its_skill() -> None:
    assert CONFIG.difficulty("fold the towel", "pick a corner", "Pick") == "difficult"
    assert CONFIG.difficulty("towels", "pick a corner", "Fold") == "simple"
    assert CONFIG.difficulty("towels", "take a corner", "Fold") == "difficult"
    assert CONFIG.difficulty("towels", "take a corner", "Take") == "unknown"


def test_a_scene_is_its_description_unless_a_table_says_otherwise() -> None:
    assert CONFIG.scene("a Kitchen table") == "home"
    assert CONFIG.scene("an office") == "unknown"
    assert CategoryConfig().scene("an office") == "an office"
    assert CategoryConfig().scene("") == "unknown"


@given(st.text(min_size=1), st.text(min_size=1).filter(lambda word: "=" not in word))
def test_a_row_is_a_pattern_and_a_word(pattern: str, word: str) -> None:
    assert parse_table("x", (f"{pattern}={word}",)) == ((pattern, word),)


def test_agibots_tasks_have_the_difficulty_that_the_rule_gives_them() -> None:
    """docs/agibot.md: difficult are more than five actions an episode, or what changes the shape of something soft."""
    path = Path(categories.__file__).with_name("agibot_tasks.tsv")
    rows = list(csv.DictReader(path.read_text().splitlines(), delimiter="\t"))
    numbers = [number for row in rows for number in row["tasks"].split()]
    assert len(rows) == 192
    assert len(numbers) == len(set(numbers)) == 217
    config = CategoryConfig(parse_table("--difficulty", ("agibot",)))
    for row in rows:
        soft = any(word in row["name"].lower() for word in SOFT)
        expected = "difficult" if soft or float(row["actions"]) > 5 else "simple"
        assert row["difficulty"] == expected, row
        assert config.difficulty(row["name"]) == config.difficulty(f"{row['name']}.") == expected, row
    assert config.difficulty("Juggle") == "unknown"
    assert CategoryConfig(parse_table("--difficulty", ("agibot", "*=simple"))).difficulty("Juggle") == "simple"


@pytest.mark.parametrize("row", ["simple", "=simple", "pick*="])
def test_another_row_is_refused(row: str) -> None:
    with pytest.raises(ConfigError, match=f"--difficulty '{row[:1]}.*PATTERN=WORD"):
        parse_table("--difficulty", (row,))
