"""Maps the modules of :mod:`rsjax.tokenizers.vae_blocks` to the names that ``diffusers`` gives them."""

import re
from collections.abc import Sequence

from flax.traverse_util import flatten_dict

from rsjax.tools.convert.table import Entry, Layout, Table
from rsjax.trainable import Params

_PARTS = (
    (r"(down|up)_(\d+)_block_(\d+)", r"\1_blocks.\2.resnets.\3"),
    (r"(down|up)_(\d+)_(down|up)sample", r"\1_blocks.\2.\3samplers.0"),
    (r"mid_block_(\d)", r"mid_block.resnets.\1"),
    (r"mid_attention", "mid_block.attentions.0"),
    (r"to_out", "to_out.0"),
    (r"\bnorm_out", "conv_norm_out"),
    (r"\b(kernel|scale)$", "weight"),
)
_LAYOUTS: dict[int, Layout] = {2: "linear", 4: "conv"}


def vae_table(shapes: Params, more: Sequence[tuple[str, str]] = ()) -> Table:
    """Returns an entry for each parameter.

    Args:
        shapes: the parameters' shapes.
        more: further (regular expression for a part of a dotted path, its replacement), which are applied first.
    """
    entries = []
    for path, x in flatten_dict(shapes, sep="/").items():
        key = path.replace("/", ".")
        for own, public in (*more, *_PARTS):
            key = re.sub(own, public, key)
        entries.append(Entry(key, path, _LAYOUTS[x.ndim] if path.endswith("kernel") else "same"))
    return tuple(entries)
