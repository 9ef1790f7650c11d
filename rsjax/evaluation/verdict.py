"""Says in one line whether a model predicts better than the simplest prediction, the first frame repeated.

A camera that stands still makes this baseline strong: most pixels never change. So the line compares whole frames and,
separately, the pixels that move.
"""

from collections.abc import Mapping

LEAST_DELTA = 0.5  # dB of ΔPSNR below which a model hardly follows the actions
ADVICE = "docs/finetune.md says what helps"


def verdict(metrics: Mapping[str, float | None]) -> str:
    """Returns the line; "" without the scores.

    Args:
        metrics: as in metrics.json.
    """
    whole = _gain(metrics, "psnr")
    moving = _gain(metrics, "psnr_motion")
    if whole is None:
        return ""
    scores = f"PSNR {metrics['psnr']:.1f} dB, the first frame repeated {metrics['psnr_repeat_first']:.1f}"
    if moving is not None:
        scores += f"; where it moves {metrics['psnr_motion']:.1f} and {metrics['psnr_motion_repeat_first']:.1f}"
    if moving is not None and moving < 0:
        return (
            f"Worse than repeating the first frame, also where it moves ({scores}): train longer, on more or shorter "
            f"clips; {ADVICE}"
        )
    if whole < 0:
        where = ""
        if moving is not None:
            where = " over whole frames, but better where it moves"
        return (
            f"Worse than repeating the first frame{where} ({scores}): the tokenizer blurs what stands still, so train "
            f"it longer; {ADVICE}"
        )
    delta = metrics.get("delta_psnr")
    if delta is not None and delta < LEAST_DELTA:
        return (
            f"Better than repeating the first frame ({scores}), but it hardly follows the actions (ΔPSNR {delta:.1f} "
            f"dB): train longer; {ADVICE}"
        )
    return f"Better than repeating the first frame ({scores})"


def _gain(metrics: Mapping[str, float | None], name: str) -> float | None:
    """Returns by how much a score is higher than that of the first frame repeated."""
    own = metrics.get(name)
    baseline = metrics.get(f"{name}_repeat_first")
    if own is None or baseline is None:
        return None
    return own - baseline
