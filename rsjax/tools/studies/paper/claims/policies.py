"""The uses of the world model: policies learn from its videos, are judged and improved in it, and plan with it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from rsjax.config import Config, content_key, presets
from rsjax.evaluation.registry import Unavailable
from rsjax.files import making
from rsjax.progress import Progress
from rsjax.tools.pipeline.run import Run
from rsjax.tools.policies.config import PolicyConfig
from rsjax.tools.policies.judges.judge_training import FOLDER as JUDGE
from rsjax.tools.policies.judges.judge_training import JudgeSettings, make_judge
from rsjax.tools.policies.judges.trained_judge import FILE as JUDGE_FILE
from rsjax.tools.policies.planning import closed_loop
from rsjax.tools.policies.policy_training import train_policy
from rsjax.tools.policies.run_data import RunData, sized_policy, synthetic_demos
from rsjax.tools.policies.studies import policy_evaluation
from rsjax.tools.policies.studies.improvement import Improvement, improve
from rsjax.tools.policies.studies.policy_learning import Learning, learn
from rsjax.tools.policies.studies.synthesis import CLIPS, Synthesis, synthesize
from rsjax.tools.policies.studies.trials import Trials, open_lift
from rsjax.tools.policies.worlds.actions import action_range
from rsjax.tools.studies.paper.budget import FAMILY_EPISODES, FAMILY_VIDEOS, VIDEO
from rsjax.tools.studies.paper.claim import Arm, ArmComparison, Claim, register
from rsjax.tools.studies.paper.claims.baselines import RATES
from rsjax.tools.studies.paper.measurements import FOLDER, Scores, measurement

STRONG = 0.9  # correlation with success in the simulator that counts as strong
# Seconds on 2 cores; a decision considers 96 sequences of 12 frames.
POLICY_STEP = 0.31
JUDGE_STEP = 0.12
EPISODE = 1.7
DECISION = 13.0  # estimated: twice the 6.5 s measured with 6 frames


@dataclass(frozen=True)
class Size:
    """The sizes of a cell's experiments: the same share of the full sizes for all cells of a budget.

    Attributes:
        policy: settings of every policy.
        trials: trial episodes of every policy.
        demos: the number of demonstrations that counts as many; a quarter of it counts as few.
        judge: training steps of the judge.
    """

    policy: PolicyConfig
    trials: Trials
    demos: int
    judge: int

    @classmethod
    def of(cls, config: Config) -> "Size":
        """Returns the sizes for a cell, in proportion to the share of the preset's clips that it is evaluated on."""
        share = config.eval.clips / presets.get(config.name).eval.clips
        steps, episodes, demos, judge = (max(4, round(share * whole)) for whole in (2000, 50, 200, 1000))
        policy = sized_policy("tiny" if config.clips.image_size >= 64 else "toy", steps)
        return cls(policy, Trials(episodes, together=min(10, episodes)), demos, judge)

    @property
    def few(self) -> int:
        """The number of demonstrations that counts as few."""
        return self.demos // 4


def _seconds(
    policies: float = 0, trials: float = 0, imagined: float = 0, decisions: float = 0, synthetic: float = 0
) -> Callable[[Config], float]:
    """Returns a function that estimates the seconds of training the judge and of the given numbers of further work.

    Args:
        policies: trainings of a policy.
        trials: trials of a policy, each of ``Size.trials`` episodes.
        imagined: trials in the world model, for their extra time over other trials.
        decisions: planned decisions per trial episode.
        synthetic: generated demonstrations, in units of the number that counts as many.
    """

    def seconds(config: Config) -> float:
        if not _in_lift(config):
            return 0.0
        size = Size.of(config)
        beyond = imagined * FAMILY_EPISODES.get(config.model.family, 0.0)
        acting = size.trials.episodes * (trials * EPISODE + beyond + decisions * DECISION)
        generating = synthetic * size.demos * FAMILY_VIDEOS.get(config.model.family, VIDEO)
        return JUDGE_STEP * size.judge + policies * POLICY_STEP * size.policy.train.steps + acting + generating

    return seconds


def _in_lift(config: Config) -> bool:
    return config.data is None and config.sim.env == "lift"


def _judged(run: Run, size: Size) -> RunData:
    """Returns a run's data, with a judge in its directory.

    Raises:
        Unavailable: its clips are not of Lift.
    """
    if not _in_lift(run.config):
        raise Unavailable(f"policies are tried in the simulated Lift alone; the clips are of {run.config.sim.env}")
    if not (run.directory / JUDGE / JUDGE_FILE).exists():
        make_judge(run.directory, run.data_directory, settings=JudgeSettings(steps=size.judge))
    return RunData(run.directory, run.data_directory)


def _place(run: Run, size: Size) -> Path:
    """Returns the folder that all cells on the same clips share: policies from real clips, and their trials."""
    return run.data_directory / f"policies-{content_key(run.keys()['collect'], size)}"


@measurement("policies judged", _seconds(policies=1 / 6, trials=8 * 1.5, imagined=8))
def judged(run: Run) -> Scores:
    """Rolls out eight checkpoints of a policy in the simulator and in the run's world model."""
    size = Size.of(run.config)
    data = _judged(run, size)
    place = _place(run, size)
    with making(place, wait=True), open_lift(data.simulator, size.trials) as simulator:
        demos = data.demos()
        policies = policy_evaluation.checkpoints(
            size.policy, demos.first(min(size.demos, len(demos))), place / "judged"
        )
        models = {run.directory.name: partial(data.world, size.trials.together)}
        (row,) = policy_evaluation.compare(policies, simulator, models, size.trials, place / "in-models")["runs"]
    pearson = row["pearson"]["value"]
    same = [np.equal(each["simulator"], each["world_model"]) for each in row["policies"].values()]
    return {
        "same_outcome": np.concatenate(same).astype(float).tolist(),
        "pearson": [math.nan if pearson is None else pearson],  # None: success does not vary
        "strong": [STRONG],
    }


# Two of the six policies train for twice the steps.
@measurement("policies learned", _seconds(policies=8, trials=6, synthetic=1))
def learned(run: Run) -> Scores:
    """Trains policies on few and on many demonstrations, synthetic, real and both together, and runs their trials."""
    return _learned(run, ("few", "many", "both", "real_few", "real", "repeated"))


@measurement("policies from synthetic video", _seconds(policies=4, trials=3, synthetic=1))
def learned_from_synthetic(run: Run) -> Scores:
    """Trains policies on many synthetic demonstrations, alone and beside real ones, and on the real ones alone."""
    return _learned(run, ("many", "both", "real"))


def _learned(run: Run, names: tuple[str, ...]) -> Scores:
    """Makes synthetic demonstrations; returns the success of policies that learn from them and from real ones.

    Policies from real clips alone are made once for all cells on these clips.
    """
    size = Size.of(run.config)
    data = _judged(run, size)
    place = _place(run, size)
    own = run.directory / FOLDER / "policies"
    real = data.demos()
    many = min(size.demos, len(real))
    limits = action_range(data.config, data.trained.assets.normalization)
    with Progress("synthesize", many, "demos") as progress:
        show = lambda done, total: progress.update(done)  # noqa: E731
        synthesize(data.trained, data.clips, own, Synthesis(many, batch=min(10, many)), limits, report=show)
    synthetic = synthetic_demos(own / CLIPS, run.directory)
    cells = {"few": f"synthetic-{size.few}", "many": f"synthetic-{many}", "both": f"real-{many}-synthetic-{many}"}
    controls = {"real_few": f"real-{size.few}", "real": f"real-{many}", "repeated": f"real-{many}-repeated"}
    rows: dict[str, list[bool]] = {}
    with making(place, wait=True), open_lift(data.simulator, size.trials) as simulator:
        for kind, folder in ((cells, own), (controls, place)):
            chosen = tuple(cell for name, cell in kind.items() if name in names)
            wanted = Learning((size.few, many), cells=chosen)
            made = learn(wanted, size.policy, real, synthetic, simulator, size.trials, folder / "learned")
            rows |= {row["name"]: row["success"][0] for row in made["rows"]}
    every = cells | controls
    return {name: [float(success) for success in rows[every[name]]] for name in names}


@measurement("policies improved", _seconds(policies=2, trials=10))
def improved(run: Run) -> Scores:
    """Trains a policy on few real demonstrations, and improves it in the run's world model."""
    size = Size.of(run.config)
    data = _judged(run, size)
    place = _place(run, size)
    settings = Improvement(imagined=size.demos, steps=size.policy.train.steps // 4, max_steps=size.trials.max_steps)
    demos = data.demos().first(size.few)
    model = data.world(size.trials.together)
    with making(place, wait=True), open_lift(data.simulator, size.trials) as simulator:
        policy = train_policy(size.policy, demos, place / "few")
        starts = data.first_frames(settings.imagined * settings.rounds)
        out = run.directory / FOLDER / "improved"
        result = improve(policy, demos, starts, model, simulator, settings, size.trials, out)
    last = result["rounds"][-1]
    rows = {"before": result["before"], "after": last["imagined"], "control": last["control"]}
    return {name: [float(success) for success in row] for name, row in rows.items()}


@measurement("planned", _seconds(trials=2, decisions=2 * closed_loop.PlanSettings().max_steps))
def planned(run: Run) -> Scores:
    """Plans in the run's world model and acts in the simulator."""
    size = Size.of(run.config)
    data = _judged(run, size)
    settings = closed_loop.PlanSettings(episodes=size.trials.episodes)
    with open_lift(run.config.sim, replace(size.trials, together=1)) as simulator:
        episodes = closed_loop.compare(data.trained, run.directory, simulator, settings)["episodes"]
    ways = dict.fromkeys(row["way"] for row in episodes)
    return {way: [float(row["success"]) for row in episodes if row["way"] == way] for way in ways}


_OURS = Arm("RoboScape", rate=RATES["RoboScape"])  # each arm has its family's best learning rate, as in Table 1
_OTHERS = (  # the paper compares with the last two; CogVideoX has no actions
    Arm("Genie", model="genie", equal="seconds", rate=RATES["Genie"]),
    Arm("iVideoGPT", preset="ivideogpt", equal="seconds", rate=RATES["iVideoGPT"]),
    Arm("IRASim", preset="irasim", equal="seconds", rate=RATES["IRASim"]),
)
_NOTE = "Lift and Diffusion Policy, with less training than the paper's; success is the simulator's own predicate."

register(
    Claim(
        name="policy-learning",
        title="Policies learn from generated video",
        statement=(
            "DP trained … with only generated data achieved nearly the same performance as DP trained with real data. "
            "Notably, the policy success rate exhibited consistent improvement with increasing synthetic training data."
        ),
        place="§3.3, Table 3",
        arms=(_OURS,),
        comparisons=(
            ArmComparison("success", "RoboScape", "RoboScape", "many", "real", "policies learned", margin=-0.1),
            ArmComparison("success", "RoboScape", "RoboScape", "few", "real_few", "policies learned", margin=-0.1),
            ArmComparison("success", "RoboScape", "RoboScape", "many", "few", "policies learned"),
            ArmComparison("success", "RoboScape", "RoboScape", "both", "repeated", "policies learned"),
        ),
        rank=6,
        notes=(
            _NOTE,
            "As good as real: at most 10 points worse, at equal number of demonstrations.",
            "Both together, as in the paper's table, against the real ones alone for as many steps (repeated).",
        ),
    )
)
register(
    Claim(
        name="policy-data",
        title="Policies learn more from RoboScape's video than from other models'",
        statement=(
            "We compared training the π0 model using data synthesized by CogVideoX and IRASim … indicating the "
            "superiority of our model in generating synthetic data for VLA training compared to baselines."
        ),
        place="authors' answers, reviewer isFR, second question",
        arms=(_OURS, *_OTHERS),
        comparisons=tuple(
            ArmComparison("success", "RoboScape", arm.name, score, score, "policies from synthetic video")
            for arm in _OTHERS
            for score in ("both", "many")
        ),
        rank=6,
        notes=(
            _NOTE,
            "In the paper π0 learns from 200 real and 800 synthetic demonstrations of LIBERO and succeeds in 79.1 % "
            "(RoboScape), 69.8 % (CogVideoX) and 64.8 % (IRASim) on average; from the real ones alone in 65.2 %.",
            "Here Diffusion Policies learn from as many synthetic as real ones, and from synthetic ones alone.",
            "CogVideoX has no arm: it takes no actions, so its video does not show those that a policy would learn.",
        ),
    )
)
register(
    Claim(
        name="policy-evaluation",
        title="Success in the world model follows success in the simulator",
        statement=(
            "The Pearson correlation of our model is 0.953, while the correlation of other models is rather low, "
            "indicating that our world model can be utilized as a better policy evaluator."
        ),
        place="§3.4, Fig. 5",
        arms=(_OURS, *_OTHERS),
        comparisons=(
            ArmComparison("correlation", "RoboScape", "RoboScape", "pearson", "strong", "policies judged"),
            *(
                ArmComparison(metric, "RoboScape", arm.name, score, score, "policies judged")
                for arm in _OTHERS
                for metric, score in (("correlation", "pearson"), ("same_outcome", "same_outcome"))
            ),
        ),
        rank=6,
        notes=(
            _NOTE,
            "Eight stages of one policy's training; each world model has a judge of its own.",
            "iVideoGPT and IRASim generate each frame from the last one alone (docs/policy_learning.md).",
        ),
    )
)
register(
    Claim(
        name="policy-improvement",
        title="Policies improve in the world model",
        statement="A policy that practises in the world model succeeds more often in the simulator.",
        place="a use of the model beyond the paper",
        arms=(_OURS,),
        comparisons=(
            ArmComparison("success", "RoboScape", "RoboScape", "after", "before", "policies improved"),
            ArmComparison("success", "RoboScape", "RoboScape", "after", "control", "policies improved"),
        ),
        rank=6,
        notes=(_NOTE, "The control trains for as many steps on its old demonstrations alone."),
    )
)
register(
    Claim(
        name="planning",
        title="The world model plans",
        statement=(
            "We can sample multiple potential action trajectories and use our world model to predict the future frames "
            "for each trajectory … we can select the action sequence that minimizes this energy."
        ),
        place="authors' answers, on planning",
        arms=(_OURS,),
        comparisons=tuple(
            ArmComparison("success", "RoboScape", "RoboScape", method, "random", "planned")
            for method in ("cem", "mppi")
        ),
        rank=6,
        notes=("CEM and MPPI with the judge's success as the goal, against random actions.",),
    )
)
