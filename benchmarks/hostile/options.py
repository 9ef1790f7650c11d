"""Every option of every command, and every field of a preset, with absurd values of its type."""

import dataclasses
import typing
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import tyro

from benchmarks.hostile.cases import Case, Ended, Place, command, module_of
from benchmarks.hostile.values import Absurd, absurd_values
from rsjax.config import presets
from rsjax.config.config_fields import config_fields
from rsjax.tools.commands.cli import PresetOptions

RUN = "MATERIAL/run --data-dir MATERIAL/data"
POLICY = "MATERIAL/policy"

# A line of each command that works on the material, by the command and its word, and the class of its options.
LINES = {
    "demo": "demo MATERIAL/run --data-dir MATERIAL/data --video --out NEW",
    "play": f"play {RUN} --no-browser --port 0 --out NEW",
    "generate": f"generate {RUN} --out NEW",
    "train": "train debug --run-dir NEW --data-dir MATERIAL/data",
    "doctor": "doctor MATERIAL/store",
    "ingest": "ingest sim MATERIAL/store --out NEW --windows.frames 4 --workers 0",
    "inspect": "inspect MATERIAL/store --sheet MATERIAL/sheet.png",
    "store merge": "store merge NEW MATERIAL/store MATERIAL/other",
    "store split": "store split MATERIAL/store --into NEW",
    "store tokenize": "store tokenize MATERIAL/other --run MATERIAL/run",
    "export": "export lerobot MATERIAL/store NEW --codec h264",
    "export libero": "export libero NEW",
    "evaluate": f"evaluate {RUN} --overwrite",
    "compare": "compare MATERIAL/run --out NEW",
    "ablation": "ablation debug --data-dir MATERIAL/data --out NEW",
    "paper": "paper --dir NEW --data-dir MATERIAL/data --dry-run --preset debug",
    "results": "results --check",
    "record": f"record {RUN} --policies {POLICY} --out NEW",
    "adapt": f"adapt {RUN} --policy {POLICY} --out NEW",
    "judge": f"judge {RUN}",
    "finetune": "finetune MATERIAL/run --data MATERIAL/store --out NEW",
    "detect": "detect MATERIAL/store",
    "synthesize": f"synthesize {RUN} --only all --out NEW",
    "policy_learning": f"policy_learning {RUN} --size toy --synthetic MATERIAL/synthetic/clips --out NEW",
    "policy_evaluation": f"policy_evaluation {RUN} --size toy --policies {POLICY} {POLICY}/at-2 --out NEW",
    "improve": f"improve {RUN} --policy {POLICY} --size toy --out NEW",
    "plan": "plan MATERIAL/run --energy tokens",
    "serve": f"serve {RUN} --port 0",
    "save": "save MATERIAL/run NEW --data-dir MATERIAL/data",
    "hub push": "hub push MATERIAL/saved user/name",
    "hub pull": "hub pull user/name NEW",
    "describe": "describe debug",
    "compile": "compile debug",
    "bench": "bench debug --only matmul",
    "convert": "convert genie MATERIAL/file NEW",
    "replay": f"replay {RUN}",
    "softness": f"softness {RUN}",
}
# Words of the error with which a line itself ends on the material, or on a machine without an optional package.
OWN_END = {
    "policy_learning": "ends in success",
    "improve": "ends in success",
    "hub push": "huggingface_hub",
    "hub pull": "huggingface_hub",
    "compile": "compiler",
    "convert": "unknown kind of file",
}

# Paths in the place of the first path of a line that are none, or of something else.
PATHS = {
    "empty": "",
    "not there": "MATERIAL/nowhere",
    "a file": "MATERIAL/file",
    "an empty directory": "MATERIAL/empty",
    "a fifo": "MATERIAL/fifo",
    "too long": "n" * 5000,
    "no text": "\udcff",
    "a device": "/dev/zero",
    "a store": "MATERIAL/store",
    "a run": "MATERIAL/run",
    "a policy": "MATERIAL/policy",
    "a saved model": "MATERIAL/saved",
    "a LeRobotDataset": "MATERIAL/synthetic/lerobot-v3.0",
    "the material": "MATERIAL",
}
# What may be accepted, and why: by command, option and value, each a word or "*".
DOCUMENTED: tuple[tuple[str, str, str, str], ...] = (
    ("serve", "data_dir", "*", "without clips a reset needs a frame of its own (docs/serve.md)"),
    ("play", "data_dir", "*", "without clips a session begins with an uploaded picture (docs/play.md)"),
    ("*", "port", "0", "a free port"),
    ("serve", "lanes", "0", "as many as fit the device"),
    ("synthesize", "fps", "0", "as the clips say"),
    ("synthesize", "noise", "0", "no noise, the default"),
    ("save", "license", "*", "any text"),
    ("save", "note", "*", "any text"),
    ("ingest", "windows.most_motion", "inf", "no bound, the default"),
    ("ingest", "windows.rate", "1e30", "episodes recorded at a lower rate are quarantined, by name"),
    ("*", "json", "MATERIAL/file", "an older file is replaced"),
    ("*", "dump", "MATERIAL/file", "an older file is replaced"),
    ("*", "fix", "MATERIAL/file", "an older file is replaced"),
    ("*", "clip", "0", "the first clip"),
    ("*", "seed", "0", "the first seed"),
    ("demo", "port", "*", "with --video there is no server"),
    ("train", "data_dir", "*", "the directory of data sets is made when the first is"),
    ("ablation", "data_dir", "*", "the directory of data sets is made when the first is"),
    ("train", "name", "*", "any text names a run"),
    ("train", "sim.camera", "*", "the simulator knows its cameras, and refuses others when it opens"),
    ("*", "coordinator", "", "one process, the default"),
    ("*", "eval.weights", "", "no networks of metrics"),
    ("*", "eval.depth_estimator", "", "none, the default"),
    ("train", "train.start_from", "", "from nothing, the default"),
    ("train", "tokenizer_train.start_from", "", "from nothing, the default"),
    ("train", "runtime.wandb", "", "off, the default"),
    ("generate", "temperature", "0", "the most probable code"),
    ("evaluate", "temperature", "0", "the most probable code"),
    ("generate", "top_k", "0", "all codes, the default"),
    ("generate", "window_stride", "0", "half of the window, the default"),
    ("generate", "actions_from", "0", "the first clip"),
    ("evaluate", "horizon", "0", "the clips' own, the default"),
    ("evaluate", "resolution", "0", "the clips' own, the default"),
    ("ablation", "seeds", "0", "the first seed"),
    ("bench", "only", "", "everything, the default"),
    ("save", "clips", "0", "no clips beside the weights"),
    ("compile", "clips", "0", "read with --part sample alone"),
    ("judge", "reconstructed", "0", "none"),
    ("adapt", "steps", "0", "by --minutes, the default"),
    ("ingest", "camera", "*", "episodes without it are quarantined, by name"),
    ("ingest", "workers", "0", "in this process"),
    ("ingest", "workers", "-1", "one per core, the default"),
    ("ingest", "test_share", "0", "no test split"),
    ("ingest", "validation_share", "0", "no validation split, the default"),
    ("ingest", "split_seed", "0", "the default"),
    ("ingest", "actions.offset", "*", "frames, either way"),
    ("ingest", "windows.rate", "0", "every frame, the default"),
    ("ingest", "windows.least_motion", "0", "no bound, the default"),
    ("ingest", "windows.most_motion", "*", "clips that move more are left out, and counted"),
    ("evaluate", "action_draws", "0", "no ΔPSNR"),
    ("judge", "generated", "0", "none"),
    ("generate", "clips", "0", "the first clip"),
    ("ablation", "cell", "0", "the first cell"),
    ("ingest", "gpus", "0", "none, the default"),
    ("finetune", "steps", "0", "the world model stays as it is"),
    ("finetune", "rate", "0", "chosen by the recordings, the default"),
    ("finetune", "workers", "-1", "one per core, the default"),
    ("finetune", "steps", "-1", "by the clips, the default"),
    ("finetune", "tokenizer_steps", "-1", "by the clips, the default"),
    ("finetune", "short_share", "0", "none, the default"),
    ("finetune", "frames", "0", "the default"),
    ("finetune", "camera", "", "the default"),
    ("finetune", "split_seed", "0", "the default"),
    ("plan", "lpips_weights", "*", "read with --energy lpips alone"),
    ("policy_evaluation", "size", "*", "read without --policies alone"),
    ("policy_evaluation", "steps", "0", "those of the size, the default"),
    ("policy_evaluation", "demos", "0", "read without --policies alone"),
    ("policy_evaluation", "videos", "0", "none"),
    ("policy_evaluation", "imagined", "0", "four times --episodes, the default"),
    ("policy_evaluation", "judge_with", "", "off, the default"),
    ("*", "path", "a saved model", "a saved model is a model"),
    ("softness", "data_dir", "*", "the directory of data sets is made when the first is"),
    ("export libero", "crf", "0", "without loss"),
    ("export libero", "seed", "*", "a seed"),
    ("*", "seed", "99999999", "a seed"),
    ("ablation", "seeds", "99999999", "a seed"),
    ("paper", "first_seed", "99999999", "a seed"),
    ("*", "split_seed", "99999999", "a seed"),
    ("*", "steps", "99999999", "a long training, which shows its time and goes on where it was stopped"),
    ("*", "train_steps", "99999999", "a long training, as above"),
    ("*", "tokenizer_steps", "99999999", "a long training, as above"),
    ("finetune", "patience", "99999999", "never ends early"),
    ("*", "eval.batch_size", "99999999", "all clips at once"),
    ("train", "eval.batch_size", "99999999999", "all clips at once"),
    ("generate", "top_k", "99999999", "all codes"),
    ("ingest", "windows.hop", "99999999", "one window of each episode"),
    ("judge", "clips", "99999999", "all clips"),
    ("judge", "reconstructed", "99999999", "all clips"),
    ("judge", "generated", "99999999", "all clips"),
    ("judge", "validation_clips", "99999999", "all clips"),
    ("save", "clips", "99999999", "all clips"),
    ("save", "measured", "99999999", "all clips"),
    ("*", "videos", "99999999", "of all episodes"),
)


def cases() -> Iterator[Case]:
    """Yields a case for every option of every command with every absurd value of its type."""
    for name in LINES:
        for option, hint in options_of(name).items():
            for absurd in absurd_values(option.rpartition(".")[2], hint):
                yield _case("options", name, LINES[name], option, absurd)
        yield Case(
            f"options: {name}, an option that there is not", _running(LINES[name], "--ofenrohr", "1"), ("ofenrohr",)
        )
        yield Case(f"options: {name}, an option without its value", _running(LINES[name], "--data-dir"), ())
        yield from _paths(name)
    for field, entry in config_fields(presets.get("debug")).items():
        absurd_ones = absurd_values(field.rpartition(".")[2], entry.kind)
        if not field.startswith("eval."):
            absurd_ones = absurd_ones[:8]  # what is absurd for every number
        for absurd in absurd_ones:
            yield _case("fields", "train", LINES["train"], field, absurd)


def options_of(name: str) -> dict[str, Any]:
    """Returns the declared type of each option of a command, by its name; positional ones are left out."""
    found = dict(_hints(type(_options(name)), ""))
    if LINES[name].split()[1] == "debug":
        found |= dict(_hints(PresetOptions, ""))
    return found


def _paths(name: str) -> Iterator[Case]:
    words = LINES[name].split()
    place = next((number for number, word in enumerate(words) if word.startswith("MATERIAL")), None)
    if place is None or words[place - 1].startswith("--"):
        return
    for kind, path in PATHS.items():
        if path == words[place]:
            continue
        line = [*words[:place], path, *words[place + 1 :]]
        shown = (path.rpartition("/")[2][:20], words[place].rpartition("/")[2]) if path else ()
        if not path.isprintable():
            shown = (*shown, ascii(path)[1:-1])
        title = f"paths: {name} of a path that is {kind}"
        yield Case(title, _running_words(line), shown, _documented(name, "path", kind))


def _options(name: str) -> Any:
    command_name, _, word = name.partition(" ")
    module = module_of(command_name)
    if name == "export libero":
        return module.LiberoOptions()
    if word:
        return module.ACTIONS[word][0]
    if command_name == "ingest":
        return module.IngestOptions()
    return module.Options()


def _hints(kind: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    hints = typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        bare = typing.get_args(hint)[0] if typing.get_origin(hint) is typing.Annotated else hint
        if tyro.conf.Positional in typing.get_args(hint):
            continue
        if dataclasses.is_dataclass(bare):
            yield from _hints(bare, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", bare


def _case(group: str, name: str, line: str, option: str, absurd: Absurd) -> Case:
    flag = f"--{option.replace('_', '-')}"
    shown = absurd.word if len(absurd.word) < 40 else f"{absurd.word[:8]}… ({len(absurd.word)} characters)"
    words: tuple[str, ...] = (
        flag,
        flag.removeprefix("--"),
        option.rpartition(".")[2],
        option.rpartition(".")[2].replace("_", "-"),
    )
    if name in OWN_END:
        words = (*words, OWN_END[name])
    if len(absurd.word) > 2:
        words = (*words, absurd.word.replace("MATERIAL/", "")[:20])
    if not absurd.word.isprintable():
        words = (*words, ascii(absurd.word)[1:-1])
    reason = _documented(name, option, absurd.word)
    return Case(
        f"{group}: {name} {flag} {shown!r}", _running(without(line, flag), f"{flag}={absurd.word}"), words, reason
    )


def without(line: str, flag: str) -> str:
    """Returns a command line without an option and its values."""
    kept = []
    skipping = False
    for word in line.split():
        if word.startswith("--"):
            skipping = word == flag
        if not skipping:
            kept.append(word)
    return " ".join(kept)


def _documented(name: str, option: str, word: str) -> str:
    for *pattern, reason in DOCUMENTED:
        if all(each in ("*", value) for each, value in zip(pattern, (name, option, word), strict=True)):
            return reason
    return ""


def _running(line: str, *more: str) -> Callable[[Place], Ended]:
    return _running_words((*line.split(), *more))


def _running_words(words: Sequence[str]) -> Callable[[Place], Ended]:
    return lambda place: command(words, place)
