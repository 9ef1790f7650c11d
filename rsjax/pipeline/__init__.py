"""The main job: six stages from an empty directory to a report."""
