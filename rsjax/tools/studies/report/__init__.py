"""Presents a run: videos, figures, and one self-contained HTML page."""
