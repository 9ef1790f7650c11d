import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rsjax.data.clips import spread


@given(st.integers(1, 500), st.integers(1, 60))
def test_numbers_are_spread_evenly_from_the_first_to_the_last(size: int, count: int) -> None:
    numbers = spread(range(size), count)
    assert len(numbers) == min(size, count) and numbers == sorted(set(numbers))
    assert numbers[0] == 0 and numbers[-1] == (size - 1 if count > 1 else 0)
    steps = np.diff(numbers)
    assert not len(steps) or steps.max() - steps.min() <= 1


def test_a_split_no_larger_than_asked_for_is_taken_whole() -> None:
    assert spread(range(7), 7) == spread(range(7), 20) == list(range(7))
