import pytest

from rsjax.tools.pipeline.summary import _rank


@pytest.mark.parametrize(
    ("rank", "words"),
    [
        (0, "typical"),
        (1, "worst of 100"),
        (2, "2nd worst of 100"),
        (3, "3rd worst of 100"),
        (4, "4th worst of 100"),
        (12, "12th worst of 100"),
        (20, "20th worst of 100"),
        (21, "21st worst of 100"),
        (22, "22nd worst of 100"),
    ],
)
def test_a_rank_in_words(rank: int, words: str) -> None:
    assert _rank(rank, 100) == words
