"""``python -m experiments.inspect`` is ``rsjax inspect``."""

from rsjax.tools.commands.inspect import main

if __name__ == "__main__":
    main()
