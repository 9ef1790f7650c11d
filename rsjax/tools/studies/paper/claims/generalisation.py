"""The authors' answers on unseen scenes and on long rollouts."""

import shutil
from dataclasses import replace
from functools import partial

from rsjax.config import Config
from rsjax.data.store import Store, open_store
from rsjax.evaluation.evaluate import EvaluationClips, evaluate
from rsjax.evaluation.protocols import PROTOCOLS
from rsjax.evaluation.registry import Unavailable
from rsjax.models.load_run import load
from rsjax.progress import Progress
from rsjax.tools.pipeline.depth_stage import depth_estimator
from rsjax.tools.pipeline.evaluation_clips import longer_episodes
from rsjax.tools.pipeline.run import Run
from rsjax.tools.sim.collect import collect, collection_key
from rsjax.tools.sim.unseen import collect_unseen, unseen_splits
from rsjax.tools.studies.compare.published import published_by_metric
from rsjax.tools.studies.paper import budget
from rsjax.tools.studies.paper.claim import ESTIMATED_DEPTH, Arm, ArmComparison, Claim, register
from rsjax.tools.studies.paper.claims.baselines import RATES
from rsjax.tools.studies.paper.measurements import FOLDER, Scores, measurement

HORIZON = PROTOCOLS["horizon48"].horizon


def _by_protocol(run: Run, name: str, store: Store, split: str, draws: int) -> Scores:
    """Evaluates a run on as many clips of a store as its own evaluation has, and returns the scores per clip."""
    protocol = replace(PROTOCOLS[name], clips=run.config.eval.clips, action_draws=draws, splits=(split,))
    eval_clips = EvaluationClips.read(store, split, protocol, run.config.clips)
    parts = run.directory / FOLDER / f"{name}-{split}"
    estimator = depth_estimator(run)
    result = evaluate(load(run.directory), run.open_clips(), eval_clips=eval_clips, folder=parts, estimator=estimator)
    shutil.rmtree(parts, ignore_errors=True)
    return result.per_clip


@measurement("48 frames", partial(budget.evaluation_seconds, draws=0, frames=HORIZON))
def rollouts(run: Run) -> Scores:
    """Scores rollouts of 48 predicted frames, on longer episodes of another seed."""
    longer = longer_episodes(run.config.sim, HORIZON + 1, run.config.eval.clips)
    path = run.data_directory / f"{longer.env}-{collection_key(longer)}"
    with Progress("collect", longer.episodes, "longer episodes") as progress:
        collect(longer, path, lambda done, total: progress.update(done))
    return _by_protocol(run, "horizon48", open_store(path), "test", 0)


def _register_unseen(split: str, name: str) -> None:
    def seconds(config: Config) -> float:
        return budget.evaluation_seconds(config) if split in unseen_splits(config.sim) else 0.0

    @measurement(name, seconds)
    def unseen(run: Run) -> Scores:
        """Scores simulated clips whose task, camera or colours do not occur in training."""
        config = run.config
        if split not in unseen_splits(config.sim):
            raise Unavailable(f"{config.sim.env} has one task; the preset roboscape_multitask holds tasks out")
        with Progress("collect", config.eval.clips * len(unseen_splits(config.sim)), "unseen episodes") as progress:
            show = lambda done, total: progress.update(done)  # noqa: E731
            store = collect_unseen(config.sim, run.open_clips(), config.eval.clips, show)
        return _by_protocol(run, "unseen", store, split, config.eval.action_draws)


_PLACES = {"unseen_camera": "unseen cameras", "unseen_color": "unseen colours", "unseen_task": "unseen tasks"}
for _split, _name in _PLACES.items():
    _register_unseen(_split, _name)

register(
    Claim(
        name="horizon",
        title="Rollouts to 48 frames",
        statement="Our current model can reliably support a maximum rollout inference of up to 48 frames.",
        place="authors' answers, reviewer XShs",
        arms=(
            Arm("RoboScape", rate=RATES["RoboScape"]),
            Arm("Genie", model="genie", equal="seconds", rate=RATES["Genie"]),
        ),
        comparisons=(
            *(
                ArmComparison("psnr", "RoboScape", "RoboScape", f"psnr{part}", f"psnr_repeat_first{part}", "48 frames")
                for part in ("", "_second_half")
            ),
            *(
                ArmComparison(f"{name}", "RoboScape", "RoboScape", name, f"{name}_repeat_first", "48 frames")
                for name in ("cube_error_widths", "gripper_error_widths")
            ),
            ArmComparison("psnr", "RoboScape", "Genie", "psnr_second_half", "psnr_second_half", "48 frames"),
        ),
        rank=2,
        notes=(
            "Reliable is taken to mean: better than repeating the first frame, also in the second half (frames 26 to "
            "49) and in the places of cube and gripper in the last frame. Trained on 16 frames.",
        ),
    )
)
register(
    Claim(
        name="unseen",
        title="Scenes never seen",
        statement=(
            "We also explicitly evaluate the model's performance on an unseen scenario … validating the generality of "
            "our introduced physics representations."
        ),
        place="authors' answers, reviewer XShs",
        arms=tuple(
            replace(arm, rate=RATES[arm.name], published=published_by_metric(arm.name, "unseen"))
            for arm in (
                Arm("RoboScape"),
                Arm("Genie", model="genie", equal="seconds"),
                Arm("IRASim", preset="irasim", equal="seconds"),
                Arm("CogVideoX", preset="cogvideox", equal="seconds"),
            )
        ),
        comparisons=tuple(
            ArmComparison(metric, "RoboScape", other, measurement=name)
            for other in ("Genie", "IRASim", "CogVideoX")
            for name in _PLACES.values()
            for metric in ("psnr", *ESTIMATED_DEPTH, "delta_psnr", "psnr_motion", "lpips_alex")
            if (other, metric) != ("CogVideoX", "delta_psnr")  # CogVideoX has no actions
        ),
        rank=2,
        notes=(
            "The held-out episodes again, from other cameras and with other colours of the objects; and tasks that "
            "were held out, where the preset has several.",
        ),
    )
)
