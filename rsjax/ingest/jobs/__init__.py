"""Running the work items of an ingest: on this machine or on a Ray cluster, resumable."""
