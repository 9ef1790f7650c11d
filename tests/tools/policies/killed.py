"""``experiments.adapt``, killed without warning after a checkpoint of the world model's training.

``python -m tests.tools.policies.killed RUN …``.
"""

from rsjax.tools.commands.adapt import main
from tests.tools.pipeline.killed import in_world_model

if __name__ == "__main__":
    in_world_model()
    main()
