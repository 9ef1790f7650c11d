"""rsjax: a world model that robots can learn in.

>>> import rsjax
>>> model = rsjax.load("tiny")
>>> clip = rsjax.examples("tiny")[0]
>>> video = model.generate(clip["rgb"][:1], clip["actions"])

``docs/api.md`` describes the whole API.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rsjax.clip import Clip
    from rsjax.data.store import Source, Store
    from rsjax.models.trained import TrainedModel

__version__ = "0.2.0"
__all__ = ["__version__", "examples", "load", "open_store", "write_store"]


def load(run: "Path | str") -> "TrainedModel":
    """Loads a trained world model.

    Args:
        run: ``"tiny"`` or ``"multitask"``, the models in the package; a directory that ``model.save`` or ``rsjax save``
            wrote; or a run directory of ``rsjax train``, such as ``"runs/tiny"``.

    Returns:
        A model whose ``generate``, ``plan``, ``encode`` and ``decode`` take and return numpy arrays, and whose ``save``
        writes it to a directory.

    Raises:
        rsjax.errors.UserError: the model is missing, unfinished or damaged, or was made by another version of rsjax.
    """
    from rsjax.models.load_run import load as load_run  # jax is imported when it is needed, not with the package

    return load_run(run)


def examples(model: "Path | str" = "tiny") -> "Source":
    """Opens the held-out clips that lie beside a saved model, such as the one in the package.

    Returns:
        The clips: ``len(clips)``, and ``clips[0]``, a dict with the fields of :class:`rsjax.clip.Clip`.

    Raises:
        rsjax.errors.UserError: there are none, or ``model`` is no path.
    """
    from rsjax.data import store
    from rsjax.files import checked_path
    from rsjax.model_directory import CLIPS, locate

    return store.open_store(locate(checked_path(model, "model")) / CLIPS).source("test")


def open_store(path: "Path | str") -> "Store":
    """Opens a store of clips, such as ``rsjax train`` and ``rsjax ingest`` write.

    Args:
        path: the store's directory.

    Returns:
        A store: ``store.splits`` names its splits, ``store.source("test")[0]`` is the first test clip, a dict with the
        fields of :class:`rsjax.clip.Clip`.

    Raises:
        rsjax.data.store.StoreError: the store is missing, incomplete or damaged.
    """
    from rsjax.data import store

    return store.open_store(path)


def write_store(
    path: "Path | str",
    clips: "Iterable[Mapping[str, Any] | Clip]",
    *,
    test_share: float = 0.1,
    generated: bool = False,
) -> "Store":
    """Writes a store of clips, on which ``rsjax train PRESET --store PATH`` can train.

    Args:
        path: the store's directory; an older store there is replaced once the new one is complete.
        clips: read once, one at a time; all have the same shape. Each is a :class:`rsjax.clip.Clip` or a dict with

            - ``rgb``: uint8 (T, S, S, 3), RGB, upright;
            - ``actions``: (T, A), where row t led from frame t-1 into frame t, and row 0 is zeros;
            - ``depth``, if it is known: z-depth in metres, (T, S, S), above 0;
            - ``tracks`` and ``visible``, if they are known: (N, T, 2), x and y from 0 to 1 across the image, and
              (N, T), bool; given for all clips or for none;
            - ``success``: one bool, or one for each frame; ``fps``: frames per second, above 0;
            - ``task``, ``difficulty``, ``scene``, ``segment``, ``skill``: strings by which a curriculum or a split
              chooses clips;
            - ``episode``: a name; all clips of one episode are in one split. By default each clip is an episode;
            - ``provenance``: further JSON-ready values.

            Only ``rgb`` and ``actions`` are required.
        test_share: share of the episodes, chosen by a hash of their names, whose clips are the test split. With 0 the
            test split is empty, and ``rsjax train`` refuses to train a world model on the store.
        generated: whether a world model made the clips, as ``model.generate`` does. Each clip's provenance then has the
            source "generated", by which exports, ``rsjax detect`` and other tools tell it from a recording.

    Returns:
        The store, opened.

    Raises:
        rsjax.data.store.StoreError: a clip lacks a field or has a wrong one (the message names its number), or ``path``
            holds something that is not a store.
        rsjax.files.FileError: the disk is full, or ``path`` is not writable.
    """
    from rsjax.data import build

    return build.write_clips(path, clips, test_share, generated)
