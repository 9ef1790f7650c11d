"""Sources of actions other than a person: a clip, random draws, a policy, a planner.

Axes: A action dimensions, S×S pixels.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from rsjax.errors import UserError
from rsjax.tools.play.messages import Refused, choice, whole
from rsjax.tools.play.play_run import PlayRun
from rsjax.tools.play.session import Session
from rsjax.tools.play.tree import Branch, Node
from rsjax.tools.policies.judges.judge_training import FOLDER
from rsjax.tools.policies.judges.trained_judge import FILE
from rsjax.tools.policies.planning.closed_loop import EnergyName, PlanSettings, actors
from rsjax.tools.policies.planning.planner import PlannerConfig
from rsjax.tools.policies.worlds.world import Actor

KINDS = ("clip", "random", "policy", "planner")
PLANNER = PlannerConfig()


@dataclass
class Acting:
    """A policy or planner that acts in one branch, because it remembers earlier frames.

    Attributes:
        last: the frame that its last action led to; after any other frame, a new policy or planner takes over.
    """

    kind: str
    act: Actor
    last: Node | None = None


@dataclass
class Sources:
    """The sources of actions in one session; each branch has its own policy or planner."""

    run: PlayRun
    acting: dict[int, Acting] = field(default_factory=dict)

    def action(self, session: Session, branch: Branch, source: dict[str, Any]) -> Float[np.ndarray, " A"]:
        """Returns the action that leads to a branch's next frame. This may be slow: a planner tries many actions.

        Raises:
            Refused: the source is missing or damaged, or has no action for this frame.
        """
        kind = choice(source, "kind", KINDS)
        frame = len(branch.nodes)
        if reason := reasons(self.run)[kind]:
            raise Refused("no_source", reason)
        if kind == "clip" and "clip" in source:
            actions = self.run.clip(whole(source, "clip", 0, 2**31))["actions"]
            return actions[1 + (frame - 1) % (len(actions) - 1)]
        if kind == "clip":
            if session.start is None or session.start.clip is None:
                raise Refused("no_action", "a picture has no actions of its own; choose a clip's")
            actions = session.start.clip["actions"]
            if frame >= len(actions):
                raise Refused("no_action", f"the clip ends after {len(actions)} frames")
            return actions[frame]
        if kind == "random":
            return self.run.controls.random(np.random.default_rng([session.seed, branch.draw, frame]))
        acting = self.acting.get(branch.number)
        if acting is None or acting.kind != kind or acting.last is not branch.nodes[-1]:
            try:
                if kind == "policy":
                    assert self.run.policy is not None
                    act: Actor = self.run.policy.actor(session.seed)
                else:
                    settings = PlanSettings(PLANNER, methods=("cem",), energy=_energy(self.run))
                    planner = actors(self.run.trained, self.run.data.run, settings)["cem"]
                    act = planner(session.seed, branch.nodes[0].state.rgb)
            except UserError as error:
                raise Refused("no_source", str(error)) from error
            acting = Acting(kind, act)
            self.acting[branch.number] = acting
        state = branch.nodes[-1].state
        last_frame = {"rgb": state.rgb[None]}
        if session.has_depth and (depth := session.engine.branching(True).depth(state)) is not None:
            last_frame["depth"] = depth[None]
        return np.asarray(acting.act(last_frame), np.float32)[0]

    def acted(self, branch: Branch, source: dict[str, Any] | None) -> None:
        """Notes that an action of this source (None: a person) led to the branch's last frame."""
        acting = self.acting.get(branch.number)
        if acting is not None and source is not None and source["kind"] == acting.kind:
            acting.last = branch.nodes[-1]


def reasons(run: PlayRun) -> dict[str, str]:
    """Returns, for each kind of source, why it is missing; "" if it is there."""
    config = run.data.config
    why = {"stick": "", "clip": run.missing, "random": "", "policy": "", "planner": ""}
    if run.policy is None:
        why["policy"] = "no policy was named with --policy"
    if config.data is not None or config.sim.env != "lift":
        why["planner"] = "planning needs a run on the simulated Lift"
    elif _energy(run) == "judge" and not (run.data.run / FOLDER / FILE).exists():
        why["planner"] = f"the run has no judge; rsjax judge {run.data.run} trains one"
    return why


def _energy(run: PlayRun) -> EnergyName:
    """Returns what the planner minimises: by the model's own success head if it has one."""
    if getattr(run.data.config.model, "state_heads", None) is None:
        return "judge"
    return "success"
