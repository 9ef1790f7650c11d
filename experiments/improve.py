"""``python -m experiments.improve`` is ``rsjax improve``."""

from rsjax.tools.commands.improve import main

if __name__ == "__main__":
    main()
