"""Compares planning in a world model with other ways to act, in a closed loop with the simulator.

All ways act in the same episodes, because equal seeds give equal starts. The goal image of an episode is the last frame
of the scripted expert's episode from the same start; the planner does not see how the expert gets there.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.artifact import make_once
from rsjax.config import content_key
from rsjax.config.fields import require, require_range
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.evaluation.statistics import wilson
from rsjax.files import content_hash, write_file, write_json
from rsjax.model_directory import locate, output_directory
from rsjax.models.trained import TrainedModel
from rsjax.progress import Progress
from rsjax.tools.policies.judges.head_judge import HeadJudge, head_rule
from rsjax.tools.policies.judges.judge import frames_of, judge_key
from rsjax.tools.policies.judges.judge_training import FOLDER
from rsjax.tools.policies.judges.trained_judge import TrainedJudge, load_judge
from rsjax.tools.policies.judges.validation import markdown, summary
from rsjax.tools.policies.planning.energies import (
    RecentFrames,
    imagined,
    judged,
    lpips_distance,
    pixel_distance,
    success,
    token_distance,
)
from rsjax.tools.policies.planning.planner import Energy, Planner, PlannerConfig, Propose
from rsjax.tools.policies.planning.proposals import SimilarClips, policy_rollouts, similar_clips
from rsjax.tools.policies.policy import Policy, check_fits
from rsjax.tools.policies.studies.trials import FPS
from rsjax.tools.policies.worlds.actions import check_takes_actions
from rsjax.tools.policies.worlds.model_world import model_key
from rsjax.tools.policies.worlds.world import FIRST_SEED, Actor, Observation, World, run_episodes
from rsjax.tools.sim.expert import skilled_expert
from rsjax.tools.studies.report.video import write_mp4
from rsjax.tools.studies.tables import ABSENT, Table, as_markdown

EnergyName: TypeAlias = Literal["judge", "success", "tokens", "pixels", "lpips"]
MakeActor: TypeAlias = Callable[[int, UInt8[np.ndarray, "S S 3"]], Actor]  # from an episode's seed and goal image
MakePropose: TypeAlias = Callable[[int], Propose]  # from an episode's seed
SIMILAR = "similar clips"
MEMORY = 2  # frames in the world model's prompt; one at an episode's beginning
HEADINGS = ("way to act", "success", "95 % interval", "steps", "seconds a decision", "numbers clipped")
VIDEOS = 3  # videos of each way to act
MARGIN = 0.02  # a planner leaves a policy's own way only for an energy that is lower by this share


@dataclass(frozen=True)
class PlanSettings:
    """The settings of a comparison.

    Attributes:
        planner: how the planner searches; its ``method`` is replaced by each of ``methods``.
        methods: planning methods to compare.
        energy: "judge": 1 - the probability of success according to the run's judge; "success": according to the
            model's own success head, by the rule that ``rsjax judge RUN --head`` chose; otherwise the distance of the
            last frame to the goal image, in the model's tokens, in pixels, or in LPIPS.
        lpips_weights: a file of weights for "lpips".
        episodes: number of episodes, with seeds from ``FIRST_SEED`` on.
        max_steps: steps of an episode, at most.
        warm_start: whether each method also plans with a policy's rollouts among its candidates, for every policy.
    """

    planner: PlannerConfig = field(default_factory=PlannerConfig)
    methods: tuple[str, ...] = ("cem", "mppi")
    energy: EnergyName = "judge"
    lpips_weights: str = ""
    episodes: int = 50
    max_steps: int = 30
    warm_start: bool = False

    def __post_init__(self) -> None:
        require_range(self, "plan", 1, 2**31, "episodes", "max_steps")
        known = get_args(EnergyName)
        require(self.energy in known, f"plan.energy is {self.energy!r}; it is one of {', '.join(known)}")
        require(self.energy != "lpips" or bool(self.lpips_weights), "plan.energy is lpips; it needs lpips_weights")


class PlanningActor:
    """Acts in one episode: makes a new plan at every frame, with the last frames as the world model's prompt.

    Attributes:
        seconds: duration of each decision.
    """

    def __init__(self, planner: Planner, width: int, depth: bool) -> None:
        self._planner = planner
        self._depth = depth
        self._frames: list[Observation] = []
        self._actions = [np.zeros(width, np.float32)]
        self.seconds: list[float] = []

    def __call__(self, observation: Observation) -> Float32[np.ndarray, "1 A"]:
        began = time.monotonic()
        self._frames.append({name: frames[0] for name, frames in observation.items()})
        # two shapes, so that two programs are compiled
        if len(self._frames) < MEMORY:
            kept = 1
        else:
            kept = MEMORY
        frames = self._frames[-kept:]
        # An episode that began with a picture has no depth, whatever the model generates.
        if self._depth and "depth" in frames[-1]:
            depth = np.stack([each["depth"] for each in frames])
        else:
            depth = None
        past = np.stack(self._actions)[1 : len(self._actions) - kept + 1]
        rgb = np.stack([each["rgb"] for each in frames])
        recent = RecentFrames(rgb, depth, np.stack(self._actions[-kept:]), past)
        action = self._planner(recent).astype(np.float32)
        self._actions.append(action)
        self.seconds.append(time.monotonic() - began)
        return action[None]


def energy_of(trained: TrainedModel, run: Path, settings: PlanSettings, goal: UInt8[np.ndarray, "S S 3"]) -> Energy:
    """Returns the energy that a planner minimises.

    Raises:
        UserError: the run has no judge for its frames, its model has no tokens or no state heads, or the weights are
            missing or damaged.
    """
    if settings.energy == "success":
        return success(trained, head_rule(run))
    if settings.energy == "judge":
        judge = load_judge(run / FOLDER, len(goal))
        return imagined(trained, judged(judge), frames_of(judge))
    if settings.energy == "tokens":
        return imagined(trained, token_distance(trained, goal))
    if settings.energy == "pixels":
        return imagined(trained, pixel_distance(goal))
    return imagined(trained, lpips_distance(Path(settings.lpips_weights), goal))


def actors(
    trained: TrainedModel,
    run: Path,
    settings: PlanSettings,
    policies: Mapping[str, Policy] | None = None,
    clips: SimilarClips | None = None,
) -> dict[str, MakeActor]:
    """Returns the ways to act by name: random, expert, similar clips, the policies, and the planner with each method.

    With ``settings.warm_start`` there is also the planner with each method and policy, named "METHOD from POLICY", and
    with clips "METHOD from similar clips".

    Raises:
        UserError: a policy's actions or frames differ in size from those of the run's clips.
    """
    policies = policies or {}
    config = trained.config
    depth = config.model.uses_depth and trained.assets.normalization.depth_range is not None
    high = np.ones(config.clips.action_dim)
    scale = np.asarray(trained.assets.normalization.action_std)
    controls = config.sim.control_steps
    half = settings.planner.candidates // 2
    horizon = settings.planner.horizon

    def random(seed: int, goal: np.ndarray) -> Actor:
        rng = np.random.default_rng(seed)
        return lambda observation: np.tile(rng.uniform(-1, 1, len(high) // controls), controls)[None]

    def planning(method: str, proposing: MakePropose | None = None) -> MakeActor:
        search = PlannerConfig(**asdict(settings.planner) | {"method": method, "hold": controls})

        def make(seed: int, goal: np.ndarray) -> Actor:
            propose = None
            own = search
            if proposing is not None:
                own = replace(search, margin=MARGIN)
                propose = proposing(seed)
            planner = Planner(energy_of(trained, run, settings, goal), -high, high, own, propose, scale)
            return PlanningActor(planner, len(high), depth)

        return make

    def rolling(policy: Policy) -> MakePropose:
        return lambda seed: partial(policy_rollouts, trained, policy, half, horizon, seed)

    def expert(seed: int, goal: np.ndarray) -> Actor:
        scripted = skilled_expert(seed)
        return lambda observation: [scripted.act]

    ways: dict[str, MakeActor] = {"random": random, "expert": expert}
    ways |= {name: policy_actor(name, policy, trained) for name, policy in policies.items()}
    proposals: dict[str, MakePropose] = {}
    if settings.warm_start:
        proposals |= {name: rolling(policy) for name, policy in policies.items()}
    if clips is not None:
        ways[SIMILAR] = lambda seed, goal: clips.actor(seed)
        proposals[SIMILAR] = lambda seed: lambda recent: clips.ways(recent.rgb[-1], half, horizon)
    for method in settings.methods:
        ways[method] = planning(method)
        ways |= {f"{method} from {name}": planning(method, proposing) for name, proposing in proposals.items()}
    return ways


def policy_actor(name: str, policy: Policy, trained: TrainedModel) -> MakeActor:
    """Returns a function that makes an actor from a policy.

    Raises:
        UserError: the policy's actions or frames differ in size from those of the run's clips.
    """
    check_fits(policy.sizes, trained.config.clips, name)

    def make(seed: int, goal: np.ndarray) -> Actor:
        return policy.actor(seed)

    return make


def compare(
    trained: TrainedModel,
    run: Path,
    simulator: World,
    settings: PlanSettings,
    policies: Mapping[str, Policy] | None = None,
    clips: Store | None = None,
) -> dict[str, Any]:
    """Runs episodes in the simulator with each way to act, and returns success rates and times.

    A :func:`folder` of the run gets the result too. It keeps finished episodes, so an interrupted comparison resumes,
    and one with more episodes goes on.

    Args:
        trained: the model of ``run``, which was trained on simulated clips.
        simulator: the world of these clips, for one episode at a time.
        policies: further ways to act, by name.
        clips: the run's clips, for ways that follow the most similar ones.

    Raises:
        UserError: the run is of recordings, its model takes no actions, or something that the energy needs is missing.
    """
    config = trained.config
    if config.data is not None:
        raise UserError(f"{run}: its clips are recordings; a closed loop needs a run on simulated clips")
    check_takes_actions(config.model, f"{run}: the model")
    policies = policies or {}
    require(
        bool(policies) or not settings.warm_start,
        "plan.warm_start is on, but there is no policy to start from; name one with --policy",
    )
    similar = None
    if clips is not None:
        similar = similar_clips(clips)
    ways = actors(trained, run, settings, policies, similar)
    side = config.sim.image_size
    energy_of(trained, run, settings, np.zeros((side, side, 3), np.uint8))  # raises before hours of episodes
    judge: TrainedJudge | HeadJudge | None = None
    validation = None
    lpips = ""
    if settings.energy == "judge":
        judge = load_judge(run / FOLDER)
        validation = judge.validation
    elif settings.energy == "success":
        judge = head_rule(run)
    elif settings.energy == "lpips":
        lpips = content_hash(Path(settings.lpips_weights))
    used = model_key(trained), judge_key(judge), *(policy.key for policy in policies.values())
    alike = replace(settings, lpips_weights=lpips, episodes=1)  # more episodes go on from these
    key = content_key("plan", 2, alike, config.sim, tuple(ways), used)
    place = folder(run, key)
    total = settings.episodes * len(ways)
    with make_once(place, key, refuse=None) as work, Progress("episodes", total, "episodes") as progress:
        done = work.metadata.get("episodes", [])
        for number in range(settings.episodes):
            seed = FIRST_SEED + number
            goal = None
            for name, make in ways.items():
                if not any(row["way"] == name and row["seed"] == seed for row in done):
                    if goal is None:
                        goal = goal_image(simulator, seed, settings.max_steps)
                    video = None
                    if number < VIDEOS:
                        video = place / f"{name.replace('/', '-')}-{number:02d}.mp4"
                    done.append(_row(simulator, name, make(seed, goal), seed, video, settings.max_steps))
                    work.save(episodes=done)
                progress.update(min(len(done), total))
        asked = [row for row in done if row["seed"] < FIRST_SEED + settings.episodes]
        result = _summary(asked, settings, key, validation)
        write_json(place / "result.json", result)
        write_file(place / "results.md", results_text(result).encode())
    return result


def folder(run: Path, key: str) -> Path:
    """Returns the folder of the comparison with that key: ``result.json``, ``results.md`` and videos."""
    return output_directory(locate(run), "plan") / key[:8]


def results_text(result: dict[str, Any]) -> str:
    """Returns the result of a comparison in Markdown: title, table, and the judge if it was the energy."""
    settings = result["settings"]
    title = f"success in the simulator, {settings['episodes']} episodes; energy: {settings['energy']}"
    rows = []
    for name, way in result["ways"].items():
        seconds = ABSENT
        if way["seconds_per_decision"] is not None:
            seconds = f"{way['seconds_per_decision']:.2f}"
        interval = f"{way['success_low']:.0%} – {way['success_high']:.0%}"
        rows.append([name, f"{way['success']:.0%}", interval, f"{way['steps']:.1f}", seconds, str(way["clipped"])])
    judge = markdown(result["judge"]) if settings["energy"] == "judge" else []
    return "\n".join([title, "", as_markdown(Table(HEADINGS, rows)), *judge, ""])


def goal_image(simulator: World, seed: int, max_steps: int) -> UInt8[np.ndarray, "S S 3"]:
    """Returns the last frame of the scripted expert's episode from the same start."""
    expert = skilled_expert(seed)
    (episode,) = run_episodes(simulator, lambda observation: [expert.act], [seed], max_steps)
    return episode.rgb[-1]


def _row(simulator: World, name: str, act: Actor, seed: int, video: Path | None, max_steps: int) -> dict[str, Any]:
    (episode,) = run_episodes(simulator, act, [seed], max_steps)
    if video:
        write_mp4(video, episode.rgb, FPS, 4)
    seconds: list[float] = []
    if isinstance(act, PlanningActor):
        seconds = act.seconds[1:] or act.seconds  # the first one compiles
    return {
        "way": name,
        "seed": seed,
        "success": bool(episode.success.any()),
        "steps": len(episode.rgb) - 1,
        "clipped": episode.clipped,
        "seconds_per_decision": float(np.median(seconds)) if seconds else None,
    }


def _summary(
    rows: list[dict[str, Any]], settings: PlanSettings, key: str, validation: dict[str, Any] | None
) -> dict[str, Any]:
    ways = {}
    for name in dict.fromkeys(row["way"] for row in rows):
        of = [row for row in rows if row["way"] == name]
        seconds = [row["seconds_per_decision"] for row in of if row["seconds_per_decision"] is not None]
        ways[name] = {
            **wilson(sum(row["success"] for row in of), len(of)).flat("success"),
            "episodes": len(of),
            "steps": float(np.mean([row["steps"] for row in of])),
            "clipped": sum(row["clipped"] for row in of),
            "seconds_per_decision": float(np.median(seconds)) if seconds else None,
        }
    return {
        "key": key,
        "settings": asdict(settings),
        "judge": summary(validation),
        "ways": ways,
        "episodes": rows,
    }
