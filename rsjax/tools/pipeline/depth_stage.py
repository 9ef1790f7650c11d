"""Trains the depth estimator ``simulator`` on a run's training clips, once for all runs on the same clips.

It lies beside the simulated data sets, so models of all families are scored by the same network.
"""

from rsjax.artifact import make_once
from rsjax.config import SIMULATOR
from rsjax.data.clips import readable, spread
from rsjax.data.store import StoreError
from rsjax.evaluation.depth_estimator import DepthEstimator
from rsjax.evaluation.depth_network import DepthNetwork, initial, train_depth_network
from rsjax.model_directory import is_saved
from rsjax.tools.pipeline.metric_files import load_estimator
from rsjax.tools.pipeline.run import Run
from rsjax.training.checkpoint import load_weights, save_weights

CLIPS = 1000  # training clips from which the network learns
_WEIGHTS = "weights"


def check_depth(run: Run) -> None:
    """Raises :class:`StoreError` if a network is to learn depth from a store whose clips have none in metres."""
    if run.config.data is None:
        return
    manifest = run.open_clips().manifest
    if manifest.get("depth_range") and (manifest.get("depth_unit") or "metres") == "metres":
        return
    where = f"{run.clips}: its clips have no depth in metres, from which"
    if run.config.eval.simulator_steps:
        raise StoreError(
            f"{where} the depth estimator {SIMULATOR} would learn; name another --eval.depth-estimator, or none"
        )
    parts = [part for stage in run.config.train.curriculum for part in stage.components]
    if any(part.annotations in ("estimated_depth", "estimated") for part in parts):
        raise StoreError(f"{where} it could be estimated; train with annotations own or estimated_tracks")


def make_depth_network(run: Run) -> None:
    """Trains the estimator, unless another run on the same clips has done so.

    Raises:
        StoreError: no training clip has depth in metres.
    """
    folder = run.output("depth_estimator")
    with make_once(
        folder,
        run.keys()["depth_estimator"],
        refuse=None,
        wait=True,
        again=not (folder / _WEIGHTS).exists(),
    ) as work:
        if work.finished:
            return
        check_depth(run)
        train = run.open_clips().source("train")
        clips = [clip for _, clip in readable(train, spread(train, CLIPS)) if clip["depth"] is not None]
        clips = [clip for clip in clips if clip["provenance"].get("depth_unit", "metres") == "metres"]
        if not clips:
            raise StoreError(f"{run.clips}: no readable training clip has depth in metres; make the clips again")
        network = train_depth_network(clips, run.config.eval.simulator_steps)
        save_weights(folder / _WEIGHTS, network.params)


def depth_estimator(run: Run) -> DepthEstimator | None:
    """Returns the estimator of a run's configuration, trained or loaded; None if it names none, or none can be trained.

    Raises:
        UserError: the estimator cannot be loaded, or the clips have no depth from which it could learn.
    """
    if not run.config.eval.simulator_steps:
        return load_estimator(run.config.eval)
    if is_saved(run.directory):  # which has no training clips
        return None
    make_depth_network(run)
    untrained = initial(run.config.clips.image_size)
    return DepthNetwork(load_weights(run.output("depth_estimator") / _WEIGHTS, untrained))
