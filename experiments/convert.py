"""``python -m experiments.convert`` is ``rsjax convert``."""

from rsjax.tools.commands.convert import main

if __name__ == "__main__":
    main()
