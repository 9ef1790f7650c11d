"""``python -m experiments.store`` is ``rsjax store``."""

from rsjax.tools.commands.store import main

if __name__ == "__main__":
    main()
