"""The API and the environments: each argument with absurd values."""

import fnmatch
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.hostile.cases import Began, Case, Ended, Place, call

NAN = float("nan")
FILE = object()  # stands for the path of a file in a case's own folder
JUNK: dict[str, Any] = {
    "None": None,
    "True": True,
    "-1": -1,
    "1.5": 1.5,
    "nan": NAN,
    "10**400": 10**400,
    "2**63": 2**63,
    "an empty text": "",
    "an existing file": FILE,
    "a long text": "x" * 100_000,
    "a surrogate": "\udcff",
    "a null byte": "a\0b",
    "bytes": b"x",
    "an empty list": [],
    "lists of other lengths": [[1], [1, 2]],
    "a dict": {"x": 1},
    "an object": object(),
    "a set": {1},
    "a function": len,
    "an array of objects": np.array([None, {}], object),
    "an array of text": np.array(["a"]),
    "an empty array": np.zeros(0),
    "a scalar array": np.array(3.0),
    "complex numbers": np.ones((2, 2), complex),
    "a date": np.array(["2026-01-01"], "datetime64[D]"),
}
# What may be accepted, and why: by shell patterns of a case's name.
DOCUMENTED = {
    "api: rsjax.write_store(path) = a surrogate": "a name of a file need not be text",
    "api: model.save(directory) = a surrogate": "a name of a file need not be text",
    "api: rsjax.write_store, field * = None": "None is a field that is left out",
    "api: rsjax.write_store, field success = True": "one value for the whole clip",
    "api: rsjax.write_store, field fps = 1.5": "a rate",
    "api: rsjax.write_store, field fps = a scalar array": "a rate",
    "api: rsjax.write_store, field task = nan": "as pandas writes a missing text",
    "api: rsjax.write_store, field task = a* *": "any text is a task",
    "api: rsjax.write_store, field episode = *": "any text or whole number names an episode",
    "api: rsjax.write_store, field provenance = a dict": "any JSON-ready values",
    "api: model.generate(depth) = None": "depth is optional",
    "api: model.generate(task) = None": "the task is optional",
    "api: model.generate(task) = a* *": "any text is a task; only CogVideoX reads it",
    "api: model.save(card) = a* *": "any text is a card",
    "environments: make, data_dir = a surrogate": "clips are looked for at reset",
    "environments: make, store = a surrogate": "clips are looked for at reset",
    "environments: make, data_dir = an existing file": "clips are looked for at reset",
    "environments: make, store = an existing file": "clips are looked for at reset",
    "environments: make, store = None": "no other store",
    "environments: make, depth = True": "the default",
    "environments: *, split = a* *": "splits are looked up at reset",
    "environments: *, judge = None": "no judge, so every reward is 0",
    "environments: *, judge = a function": "any function of frames is a judge",
    "environments: *, render_mode = None": "nothing is rendered",
    "environments: *reset*, seed* = None": "no seed",
    "environments: *reset*, options = None": "no options",
    "environments: reset, option clip = None": "any clip",
    "arrays: * as nested lists": "lists of numbers are arrays",
    "arrays: * as a matrix of another order": "the order of memory does not matter",
    "arrays: action* of -1": "whole numbers in the range",
    "arrays: actions of 2[*][*]62": "generate takes any finite action; environments clip and count",
    "arrays: action of 2[*][*]62": "environments clip and count",
    "arrays: actions of two of 2[*][*]62": "environments clip and count",
    "arrays: action with an axis too few": "a single environment takes (A,)",
    "arrays: depth of nan": "a clip without depth",
    "arrays: depth of 2[*][*]62": "what is farther than the model's range counts as its far end",
}


def documented(name: str) -> str:
    """Returns why a case may be accepted; "" if it may not."""
    return next((reason for pattern, reason in DOCUMENTED.items() if fnmatch.fnmatchcase(name, pattern)), "")


def cases() -> Iterator[Case]:
    """Yields a case for every argument with every absurd value."""
    for name, act in API.items():
        for word, value in JUNK.items():
            yield _case("api", name, word, _with(act, value))
    for name, act in ENVIRONMENTS.items():
        for word, value in JUNK.items():
            yield _case("environments", name, word, _with(act, value))
    for name, change in ARRAYS.items():
        for argument in ("frames", "actions", "depth", "tokens", "first frame", "action", "actions of two"):
            title = f"arrays: {argument} {name}"
            yield Case(title, _array_case(argument, change), accepted=documented(title))


def _case(group: str, name: str, word: str, act: Callable[[Place], Ended]) -> Case:
    title = f"{group}: {name} = {word}"
    return Case(title, act, accepted=documented(title))


def _with(act: Callable[[Place, Any], object], value: Any) -> Callable[[Place], Ended]:
    def acting(place: Place) -> Ended:
        given = value
        if value is FILE:
            given = str(place.scratch / "file")
            Path(given).touch()
        return call(lambda: act(place, given))

    return acting


@cache
def _model(run: Path) -> Any:
    import rsjax

    return rsjax.load(run)


def _trained(place: Place) -> Any:
    return _model(place.material / "run")


@cache
def _environment(run: Path, data: Path) -> Any:
    from rsjax.tools.policies.worlds.environments import WorldModelEnv

    return WorldModelEnv(run, data_dir=data)


def _env(place: Place) -> Any:
    return _environment(place.material / "run", place.material / "data")


@cache
def _environments(run: Path, data: Path) -> Any:
    from rsjax.tools.policies.worlds.environments import WorldModelVectorEnv

    return WorldModelVectorEnv(run, 2, data_dir=data)


def _two(place: Place) -> Any:
    return _environments(place.material / "run", place.material / "data")


def _clip(place: Place) -> Any:
    import rsjax

    return rsjax.open_store(place.material / "store").source("test")[0]


def _load(place: Place, value: Any) -> object:
    import rsjax

    return rsjax.load(value)


def _examples(place: Place, value: Any) -> object:
    import rsjax

    return rsjax.examples(value)


def _open_store(place: Place, value: Any) -> object:
    import rsjax

    return rsjax.open_store(value)


def _write_path(place: Place, value: Any) -> object:
    import rsjax

    if isinstance(value, str) and value and not set(value) & {"\0"}:
        value = str(place.scratch / value)
    return rsjax.write_store(value, [_clip(place)])


def _write_clips(place: Place, value: Any) -> object:
    import rsjax

    return rsjax.write_store(place.scratch / "store", value)


def _write_share(place: Place, value: Any) -> object:
    import rsjax

    return rsjax.write_store(place.scratch / "store", [_clip(place)], test_share=value)


def _write_field(name: str) -> Callable[[Place, Any], object]:
    def act(place: Place, value: Any) -> object:
        import rsjax

        return rsjax.write_store(place.scratch / "store", [_clip(place) | {name: value}])

    return act


def _source_index(place: Place, value: Any) -> object:
    import rsjax

    return rsjax.open_store(place.material / "store").source("test")[value]


def _source_split(place: Place, value: Any) -> object:
    import rsjax

    return rsjax.open_store(place.material / "store").source(value)


def _generating(**arguments: Any) -> Callable[[Place, Any], object]:
    """Returns a call of ``generate`` in which the argument that is ... takes the value."""

    def act(place: Place, value: Any) -> object:
        clip = _clip(place)
        given: dict[str, Any] = {
            "frames": clip["rgb"][:1],
            "actions": clip["actions"],
            "depth": clip["depth"][:1],
            "task": None,
        }
        given |= dict.fromkeys(arguments, value)
        return _trained(place).generate(**given)

    return act


def _planning(place: Place, value: Any) -> object:
    clip = _clip(place)
    return _trained(place).plan(clip["rgb"][:1], value)


def _saving(place: Place, value: Any) -> object:
    if isinstance(value, str) and value and not set(value) & {"\0"}:
        value = str(place.scratch / value)
    return _trained(place).save(value)


API: dict[str, Callable[[Place, Any], object]] = {
    "rsjax.load(run)": _load,
    "rsjax.examples(model)": _examples,
    "rsjax.open_store(path)": _open_store,
    "rsjax.write_store(path)": _write_path,
    "rsjax.write_store(clips)": _write_clips,
    "rsjax.write_store(test_share)": _write_share,
    **{
        f"rsjax.write_store, field {name}": _write_field(name)
        for name in ("rgb", "actions", "depth", "tracks", "visible", "success", "fps", "task", "episode", "provenance")
    },
    "source[index]": _source_index,
    "store.source(split)": _source_split,
    **{f"model.generate({name})": _generating(**{name: ...}) for name in ("frames", "actions", "depth", "task")},
    "model.plan(actions)": _planning,
    "model.encode(frames)": lambda place, value: _trained(place).encode(value),
    "model.decode(tokens)": lambda place, value: _trained(place).decode(value),
    "model.decode(tokens of rgb)": lambda place, value: _trained(place).decode({"rgb": value}),
    "model.save(directory)": _saving,
    "model.save(dtype)": lambda place, value: _trained(place).save(place.scratch / "saved", dtype=value),
    "model.save(card)": lambda place, value: _trained(place).save(place.scratch / "saved", card=value),
}


def _making(kind: str, name: str) -> Callable[[Place, Any], object]:
    def act(place: Place, value: Any) -> object:
        import gymnasium

        import rsjax.tools.policies  # noqa: F401 - registers

        given: dict[str, Any] = {"run": place.material / "run", "data_dir": place.material / "data"} | {name: value}
        return gymnasium.make(kind, disable_env_checker=True, **given)

    return act


def _of_class(kind: str, name: str) -> Callable[[Place, Any], object]:
    """Returns a call of an environment's class itself, where Gymnasium checks nothing first."""

    def act(place: Place, value: Any) -> object:
        from rsjax.tools.policies.worlds.environments import LiftEnv, WorldModelEnv
        from rsjax.tools.serve.client import RemoteWorldModelEnv

        if kind == "Remote":
            return RemoteWorldModelEnv(**({"url": NOBODY} | {name: value}))
        if kind == "Lift":
            return LiftEnv(**{name: value})
        return WorldModelEnv(**({"run": place.material / "run", "data_dir": place.material / "data"} | {name: value}))

    return act


@cache
def _lift() -> Any:
    """Returns an environment with a stand-in for the simulator; an episode in it is where work begins."""
    from rsjax.tools.policies.worlds.environments import LiftEnv, SimulatorWorld

    with patch.object(SimulatorWorld, "lift") as lift:
        lift.return_value.reset.side_effect = Began("lift")
        return LiftEnv()


def _vector(name: str) -> Callable[[Place, Any], object]:
    def act(place: Place, value: Any) -> object:
        from rsjax.tools.policies.worlds.environments import WorldModelVectorEnv

        given: dict[str, Any] = {"run": place.material / "run", "num_envs": 2, "data_dir": place.material / "data"} | {
            name: value
        }
        return WorldModelVectorEnv(**given)

    return act


def _resetting(option: str) -> Callable[[Place, Any], object]:
    return lambda place, value: _env(place).reset(options={option: value})


def _step(env: Any, value: Any) -> object:
    env.reset(seed=0)
    return env.step(value)


MODEL = "rsjax/WorldModel-v0"
NOBODY = "ws://127.0.0.1:1"  # no server listens there
ENVIRONMENTS: dict[str, Callable[[Place, Any], object]] = {
    **{
        f"make, {name}": _making(MODEL, name)
        for name in ("run", "data_dir", "store", "split", "max_steps", "judge", "out_of_range", "depth", "ofenrohr")
    },
    "WorldModelEnv, render_mode": _of_class("WorldModel", "render_mode"),
    **{f"LiftEnv, {name}": _of_class("Lift", name) for name in ("config", "max_steps", "out_of_range", "render_mode")},
    **{
        f"RemoteWorldModelEnv, {name}": _of_class("Remote", name)
        for name in ("url", "token", "max_steps", "render_mode")
    },
    "LiftEnv, reset, seed": lambda place, value: _lift().reset(seed=value),
    "LiftEnv, reset, options": lambda place, value: _lift().reset(options=value),
    **{f"vector environment, {name}": _vector(name) for name in ("run", "num_envs", "max_steps", "judge", "split")},
    "reset, seed": lambda place, value: _env(place).reset(seed=value),
    "reset, options": lambda place, value: _env(place).reset(options=value),
    **{f"reset, option {name}": _resetting(name) for name in ("clip", "draw", "rgb", "ofenrohr")},
    "step, action": lambda place, value: _step(_env(place), value),
    "reset of two, seed": lambda place, value: _two(place).reset(seed=value),
    "reset of two, seeds": lambda place, value: _two(place).reset(seed=[value, value]),
    "reset of two, options": lambda place, value: _two(place).reset(options=value),
    "step of two, actions": lambda place, value: _step(_two(place), value),
}

ARRAYS: dict[str, Callable[[np.ndarray], Any]] = {
    "without a row": lambda x: x[:0],
    "with an axis too many": lambda x: x[None, None, None],
    "with an axis too few": lambda x: x[0],
    "one wider": lambda x: np.concatenate([x, x[..., :1]], -1),
    "one narrower": lambda x: x[..., :-1],
    "as text": lambda x: x.astype(str),
    "as objects": lambda x: x.astype(object),
    "as complex numbers": lambda x: x.astype(complex),
    "as truth values": lambda x: x.astype(bool),
    "of nan": lambda x: np.full(x.shape, np.nan),
    "of inf": lambda x: np.full(x.shape, np.inf),
    "of 1e300": lambda x: np.full(x.shape, 1e300),
    "of -1": lambda x: np.full(x.shape, -1, np.int64),
    "of 2**62": lambda x: np.full(x.shape, 2**62, np.int64),
    "as nested lists": lambda x: x.tolist(),
    "masked": lambda x: np.ma.masked_all(x.shape, x.dtype),
    "as a matrix of another order": lambda x: np.asfortranarray(x),
}


def _array_case(argument: str, change: Callable[[np.ndarray], Any]) -> Callable[[Place], Ended]:
    def act(place: Place) -> Ended:
        clip = _clip(place)
        model = _trained(place)
        frames = clip["rgb"][:1]
        actions = clip["actions"]
        depth = clip["depth"][:1]
        acts: dict[str, Callable[[], object]] = {
            "frames": lambda: model.generate(change(frames), actions),
            "actions": lambda: model.generate(frames, change(actions)),
            "depth": lambda: model.generate(frames, actions, depth=change(depth)),
            "tokens": lambda: model.decode({"rgb": change(model.encode(clip["rgb"])["rgb"])}),
            "first frame": lambda: _env(place).reset(options={"rgb": change(frames)[0], "depth": depth[0]}),
            "action": lambda: _step(_env(place), change(actions[1:2])),
            "actions of two": lambda: _step(_two(place), change(actions[1:3])),
        }
        return call(acts[argument])

    return act
