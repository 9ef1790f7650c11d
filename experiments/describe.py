"""``python -m experiments.describe`` is ``rsjax describe``."""

from rsjax.tools.commands.describe import main

if __name__ == "__main__":
    main()
