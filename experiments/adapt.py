"""``python -m experiments.adapt`` is ``rsjax adapt``."""

from rsjax.tools.commands.adapt import main

if __name__ == "__main__":
    main()
