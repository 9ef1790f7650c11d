"""Evaluates trained models by a protocol. ``rsjax evaluate runs/tiny --protocol paper``"""

import dataclasses
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from rsjax.config import ConfigError, EvalConfig
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options

PROG = "rsjax evaluate"
CHANGES = (
    *("prompt_frames", "horizon", "resolution", "steps", "temperature", "samples", "clips", "repetitions"),
    *("action_draws", "depth_alignment", "depth_source"),
)
_IN_PROTOCOL = ("clips", "repetitions", "action_draws")
_SETTINGS: list[Any] = [
    (each.name, each.type | None, None)  # type: ignore[operator]  # a type, not its name
    for each in dataclasses.fields(EvalConfig)
    if each.name not in _IN_PROTOCOL
]
Settings = dataclasses.make_dataclass("Settings", _SETTINGS, frozen=True)  # fields of EvalConfig; None: the run's
Settings.__doc__ = "Settings of the metrics, as of rsjax train; default: the run's."


@dataclass(frozen=True)
class Options:
    """Generates from held-out clips by a protocol and scores all metrics; results record all that affects scores."""

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN …")] = ()
    """Run directories, made by rsjax train; saved models, on the clips in them; or tiny or multitask, the package's."""
    protocol: str = "paper"
    """paper, 1xgpt, ivideogpt-bair, horizon48, unseen, contacts, or run: that of the run's own configuration."""
    data: Path | None = None
    """A store with the clips to score; default: the run's own."""
    split: tuple[str, ...] = ()
    """Splits to score, each separately; default: the protocol's. A name may end in *."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    store: Path | None = None
    """The new path of the run's store of ingested clips, if it was moved; of a saved model, that of its training."""
    overwrite: bool = False
    """Evaluate again even if a result is up to date."""
    second_takes: bool = False
    """Simulate the scored clips once more with slightly jittered actions, for physics_iq_score."""
    as_published: bool = False
    """Pass the masks of Physics-IQ through a lossy video, as its public code does, for comparison with its numbers."""
    prompt_frames: int | None = None
    """Recorded frames that generation starts from. This and the following options change the protocol."""
    horizon: int | None = None
    """Predicted frames; 0: up to the end of the clips."""
    resolution: int | None = None
    """Pixels per side of the frames that are scored; 0: those of the clips."""
    steps: int | None = None
    """Decoding steps per frame."""
    temperature: float | None = None
    """Logits are divided by the temperature; 0: take the most probable code."""
    samples: int | None = None
    """Videos per clip, for the best of them."""
    clips: int | None = None
    """Clips to score, spread evenly over the split."""
    repetitions: int | None = None
    """Repetitions with different random draws."""
    action_draws: int | None = None
    """Random action sequences per clip and kind of ΔPSNR; 0: no ΔPSNR."""
    depth_alignment: Literal["none", "median", "affine_disparity", "l1_scale"] | None = None
    """The alignment of the depth scores in tables."""
    depth_source: Literal["branch", "estimator"] | None = None
    """The source of the depth scores in tables: the model's branch, or eval.depth-estimator."""
    eval: Settings = field(default_factory=Settings)  # type: ignore[valid-type]
    """Settings of the metrics."""
    coordinator: str = ""
    """HOST:PORT of process 0 to evaluate with several processes; not needed with Slurm, Open MPI or TPU pods."""
    processes: int | None = None
    """Number of processes, with --coordinator."""
    process_id: int | None = None
    """Number of this process, from 0, with --coordinator."""

    @property
    def made_run(self) -> Path | None:
        """The run of the last line of the output: where the first model's results are."""
        from rsjax.model_directory import locate, output_directory

        if not self.runs:
            return None
        return output_directory(locate(self.runs[0]), "evaluations").parent


@main_errors()
def main() -> None:
    """Evaluates every run and prints the folders of the results."""
    tune_process()
    options = parse_options(sys.argv[1:], PROG, Options.__doc__ or "", Options())
    if not options.runs:
        raise ConfigError(f"name a run directory; usage: {PROG} RUN [RUN …] --protocol paper (see {PROG} --help)")
    # JAX is imported only after the arguments are checked.
    from rsjax.training import distributed

    distributed.initialize(options.coordinator, options.processes, options.process_id)
    from rsjax.evaluation.results import read_result
    from rsjax.evaluation.verdict import verdict
    from rsjax.model_directory import locate
    from rsjax.tools.pipeline.evaluations import EvaluationRequest, evaluate_run

    changes = {name: value for name in CHANGES if (value := getattr(options, name)) is not None}
    if options.as_published:
        changes["as_published"] = True
    settings = {name: value for name, value in vars(options.eval).items() if value is not None}
    where = (options.data, options.split, options.store, options.overwrite, options.second_takes)
    request = EvaluationRequest(options.protocol, changes, settings, *where)
    for run in options.runs:
        for folder in evaluate_run(locate(run), options.data_dir, request):
            if distributed.is_lead():
                print(f"result: {(folder / 'result.json').absolute()}")
                print(verdict(read_result(folder).metrics))
