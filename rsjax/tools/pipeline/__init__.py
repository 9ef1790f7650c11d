"""The pipeline of a run: six stages from an empty directory to a report."""
