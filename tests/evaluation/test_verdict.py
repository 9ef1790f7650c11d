import pytest

from rsjax.evaluation.verdict import verdict

STILL = {"psnr_repeat_first": 24.0, "psnr_motion_repeat_first": 12.0}


@pytest.mark.parametrize(
    ("scores", "beginning"),
    [
        ({"psnr": 20.0, "psnr_motion": 11.0}, "Worse than repeating the first frame, also where it moves"),
        ({"psnr": 20.0, "psnr_motion": 14.0}, "Worse than repeating the first frame over whole frames, but better"),
        ({"psnr": 25.0, "psnr_motion": 14.0, "delta_psnr": 0.1}, "Better than repeating the first frame"),
        ({"psnr": 25.0, "psnr_motion": 14.0, "delta_psnr": 2.0}, "Better than repeating the first frame"),
        ({"psnr": 25.0}, "Better than repeating the first frame"),
    ],
)
def test_the_first_words_say_whether_repeating_is_better(scores: dict[str, float], beginning: str) -> None:
    line = verdict(STILL | scores)
    assert line.startswith(beginning)
    assert ("docs/finetune.md" in line) == (line.startswith("Worse") or scores.get("delta_psnr") == 0.1)


def test_nothing_is_said_without_scores() -> None:
    assert verdict({}) == verdict({"psnr": 20.0}) == ""
