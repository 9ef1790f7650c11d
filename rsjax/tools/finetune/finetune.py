"""Fine-tunes a trained world model on recordings: clips, weights to start from, and a run of the pipeline."""

from dataclasses import asdict
from pathlib import Path

from rsjax.artifact import make_once, read_mark
from rsjax.config import Config, content_key
from rsjax.data.store import Store, complete_key, open_store
from rsjax.errors import UserError
from rsjax.progress import Progress, note
from rsjax.tools.finetune.cost import estimate
from rsjax.tools.finetune.recipe import FIXED_CAMERA, MARGIN, Finetuning, finetuned, measure_tokenizer, moving_share
from rsjax.tools.finetune.recordings import Cutting, Recordings, ingest_options
from rsjax.tools.finetune.start import StartingModel, content_of, write_start
from rsjax.tools.ingest.ingest import count_steps, ingest, is_up_to_date, list_episodes
from rsjax.tools.ingest.options import make_plan, make_runner
from rsjax.tools.ingest.summary import lines
from rsjax.tools.pipeline.run import TRAINED, Run
from rsjax.tools.pipeline.stages import run_all
from rsjax.tools.pipeline.validation import held_out

CLIPS = "clips"  # in the run directory, as the next ones
START = "start"
OTHERS = "holds weights of another model, or for other clips or settings; choose another --out"


def make_clips(recordings: Recordings, cutting: Cutting, source: StartingModel, out: Path) -> Store:
    """Returns the store of clips: the one that was named, or one that is ingested into ``out`` unless it is there.

    Raises:
        UserError: the recordings cannot be ingested, or ``out`` holds a run on other clips.
    """
    if not recordings.source:
        return open_store(recordings.path)
    options = ingest_options(recordings, cutting, source.image_size, source.architecture.frames, out / CLIPS)
    plan = make_plan(recordings.source, recordings.path, options)
    listed = list_episodes(plan)
    made = complete_key(plan.out) is not None and read_mark(out / START) is not None
    if made and not is_up_to_date(plan, listed[0]):
        raise UserError(f"{out / START}: {OTHERS}")  # before these clips replace those of the run
    with Progress("ingest", count_steps(plan, listed[0]), "steps", settle=2 * len(plan.steps)) as progress:
        summary = ingest(plan, make_runner(options), lambda done, total: progress.update(done), listed)
    if summary is not None:
        print(*(f"  {line}" for line in lines(summary)[:2]), sep="\n")
    return open_store(plan.out)


def prepare(source: StartingModel, store: Store, settings: Finetuning, out: Path) -> Config:
    """Writes the weights to start from, decides on the tokenizer, and returns the run's configuration.

    An interrupted call continues, and a finished one returns the same configuration again.

    Raises:
        UserError: the clips do not fit the model, or ``out`` holds a run from another model.
    """
    folder = out / START
    start = str(folder.absolute())
    settings = settings.for_clips(source.config, len(store.source("train")))
    finetuned(source, store, start, settings, adapts=True)  # raises before anything is written
    key = content_key("finetune", content_of(source), store.manifest.get("key"), settings)
    with make_once(folder, key, refuse=OTHERS) as work:
        if not work.finished:
            write_start(source, folder)
            quality = measure_tokenizer(source, store)
            adapts = settings.tokenizer == "adapt" or (settings.tokenizer == "measure" and not quality.good)
            work.save(adapts=adapts, **asdict(quality), said=tokenizer_note(settings, str(quality), adapts))
    note(work.metadata["said"])
    share = moving_share(store)
    still = settings.keep_still == "on" or (settings.keep_still == "measure" and share < FIXED_CAMERA)
    note(camera_note(share, still))
    return finetuned(source, store, start, settings, work.metadata["adapts"], still)


def camera_note(share: float, still: bool) -> str:
    """Returns what was decided on what stands still, and why."""
    moves = f"{share:.0%} of the pixels have moved by the end of held-out clips"
    if still:
        return f"{moves}; videos keep from the first frame what does not change (--keep-still off: they do not)"
    return f"{moves}; videos keep nothing from the first frame (--keep-still on: what does not change)"


def tokenizer_note(settings: Finetuning, quality: str, adapts: bool) -> str:
    """Returns what was decided on the tokenizer, and why."""
    verdict = "it is kept"
    if adapts:
        verdict = f"it is adapted, for at most {settings.tokenizer_steps} steps"
    rule = f"kept from {MARGIN:g} dB above that on"
    if settings.tokenizer != "measure":
        rule = f"--tokenizer {settings.tokenizer}"
    return f"the model's tokenizer {quality}; {verdict} ({rule})"


def depth_advice(store: Store, config: Config) -> str:
    """Returns what clips without depth mean for the training, and how to get depth; "" if there is nothing to say."""
    if not config.model.uses_depth or store.manifest.get("depth_range"):
        return ""
    return (
        "no clip has depth: the depth loss is masked, RGB learns as before and predicted depth stays that of the old "
        "scenes; --depth video-depth-anything:checkout=DIR,weights=FILE estimates it (docs/annotate.md)"
    )


def finetune(
    source: StartingModel,
    recordings: Recordings,
    cutting: Cutting,
    settings: Finetuning,
    out: Path,
    command: str = "",
    only_cost: bool = False,
) -> Run:
    """Fine-tunes a model on recordings; an interrupted call resumes with the same bytes.

    Args:
        out: the run directory, with the clips and the weights to start from.
        command: the command that repeats this, for the report.
        only_cost: stop before the training, after the clips were made and the costs were told.

    Returns:
        The run, which is finished unless ``only_cost``.

    Raises:
        UserError: the recordings or the model cannot be read, do not fit each other, or ``out`` holds another run.
    """
    store = make_clips(recordings, cutting, source, out)
    config = prepare(source, store, settings, out)
    counts = ", ".join(f"{count} {split}" for split, count in store.counts().items())
    note(f"clips: {counts}; episodes are never divided between splits")
    if held_out(store) == "test":
        note("the store has no split validation, so the early stop reads the test clips, and scores flatter a little")
    if advice := depth_advice(store, config):
        note(advice)
    run = Run(config, out, Path("data"))
    with run.locked():
        run.prepare(overwrite=False)
        if not all(run.finished(part) for part in TRAINED):
            note(str(estimate(config)))
        if not only_cost:
            run_all(run, command=command)
    return run
