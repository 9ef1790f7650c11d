"""``python -m experiments.results`` is ``rsjax results``."""

from rsjax.tools.commands.results import main

if __name__ == "__main__":
    main()
