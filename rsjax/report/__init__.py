"""What a run looks like: videos, figures, and one self-contained HTML page."""
