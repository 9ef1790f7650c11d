"""Every setting says what it does, in the comment or the docstring that ``--help`` and the reference show."""

import dataclasses
import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest

from rsjax.config.model import families
from scripts.field_comments import fields_of, split_attributes

CONFIG = Path(__file__).parents[2] / "rsjax" / "config"
MODULES = (
    *(f"rsjax.config.{path.stem}" for path in sorted(CONFIG.glob("[!_]*.py"))),
    "rsjax.models.diffusion.config",
    "rsjax.tools.policies.config",
    "rsjax.tools.ingest.actions",
    "rsjax.tools.ingest.clips",
    "rsjax.tools.ingest.windows",
)


def settings() -> Iterator[type]:
    """Yields every class of settings."""
    registered = {kind.__module__ for kind in families().values()}  # tests register families of their own
    modules = {*MODULES, *(name for name in registered if name.startswith("rsjax."))}
    for name in sorted(modules):
        for kind in vars(importlib.import_module(name)).values():
            own = isinstance(kind, type) and dataclasses.is_dataclass(kind) and kind.__module__ == name
            if own and ("ingest" not in name or kind.__name__.endswith("Config")):
                yield kind


@pytest.mark.parametrize("kind", settings(), ids=lambda kind: kind.__name__)
def test_every_field_says_what_it_does(kind: type) -> None:
    _, described = split_attributes(inspect.getdoc(kind) or "")
    fields = {name: text or described.get(name, "") for name, _, _, text in fields_of(kind)}
    assert [name for name, text in fields.items() if not text.strip()] == []
