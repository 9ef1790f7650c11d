"""``python -m experiments.ingest`` is ``rsjax ingest``."""

from rsjax.tools.commands.ingest import main

if __name__ == "__main__":
    main()
