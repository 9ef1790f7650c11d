"""``python -m experiments.save`` is ``rsjax save``."""

from rsjax.tools.commands.save import main

if __name__ == "__main__":
    main()
