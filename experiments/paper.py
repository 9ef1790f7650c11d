"""``python -m experiments.paper`` is ``rsjax paper``."""

from rsjax.tools.commands.paper import main

if __name__ == "__main__":
    main()
