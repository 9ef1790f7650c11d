"""``python -m experiments.serve`` is ``rsjax serve``."""

from rsjax.tools.commands.serve import main

if __name__ == "__main__":
    main()
