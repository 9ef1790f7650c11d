"""``python -m experiments.compile`` is ``rsjax compile``."""

from rsjax.tools.commands.compile import main

if __name__ == "__main__":
    main()
