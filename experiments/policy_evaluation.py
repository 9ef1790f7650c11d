"""``python -m experiments.policy_evaluation`` is ``rsjax policy_evaluation``."""

from rsjax.tools.commands.policy_evaluation import main

if __name__ == "__main__":
    main()
