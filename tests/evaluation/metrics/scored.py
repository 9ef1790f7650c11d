"""What registered metrics say of a scene."""

from typing import Any

from rsjax.evaluation.registry import Scene, metrics


def score(name: str, scene: Scene) -> Any:
    function = metrics()[name].function
    assert function is not None
    return function(scene)


def per_frame(name: str, scene: Scene) -> Any:
    function = metrics()[name].per_frame
    assert function is not None
    return function(scene)
