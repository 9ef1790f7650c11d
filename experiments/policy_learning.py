"""``python -m experiments.policy_learning`` is ``rsjax policy_learning``."""

from rsjax.tools.commands.policy_learning import main

if __name__ == "__main__":
    main()
