"""What a finished ingest says of itself."""

from rsjax.annotate.runner import Counts
from rsjax.progress import duration


def lines(counts: Counts) -> list[str]:
    """Episodes, windows, and each stage's share, in lines of text; numbers of episodes and of windows add up."""
    windows = sum(counts.windows.values())
    left = [f"{number} {reason}" for reason, number in counts.windows.items() if reason != "kept" and number]
    found = [
        f"episodes {counts.found} found = {counts.done} with clips + {len(counts.filtered)} without + "
        f"{len(counts.quarantined)} quarantined",
        f"windows  {windows} found = {counts.windows['kept']} kept" + "".join(f" + {reason}" for reason in left),
    ]
    for name, row in counts.stages.items():
        rate = f", {row['clips_per_second']:.3g} clips/s and worker" if row["clips_per_second"] else ""
        found.append(
            f"{name:<9} {row['done']} done, {row['failed']} failed, {duration(row['seconds'])}, on the cores "
            f"{duration(row['cpu_seconds'])}{rate}"
        )
    worst = [f"quarantined {row['episode']} at {row['stage']}: {row['error']}" for row in counts.quarantined[:3]]
    return found + worst + ([f"… {len(counts.quarantined) - 3} more"] if len(counts.quarantined) > 3 else [])
