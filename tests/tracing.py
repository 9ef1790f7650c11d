"""What a traced program does."""

import math
from typing import Any

import jax


def products(jaxpr: Any) -> int:
    """Operations of the products and convolutions in a program, those of a scan as often as it turns."""
    total = 0
    for eqn in jaxpr.eqns:
        if eqn.primitive.name == "dot_general":
            (contracted, _), _ = eqn.params["dimension_numbers"]
            total += 2 * eqn.outvars[0].aval.size * math.prod(eqn.invars[0].aval.shape[i] for i in contracted)
        elif eqn.primitive.name == "conv_general_dilated":
            kernel, spec = eqn.invars[1].aval, eqn.params["dimension_numbers"].rhs_spec
            total += 2 * eqn.outvars[0].aval.size * kernel.size // kernel.shape[spec[0]]
        turns = eqn.params.get("length", 1) if eqn.primitive.name == "scan" else 1
        total += turns * sum(products(inner) for inner in jax.core.jaxprs_in_params(eqn.params))
    return total
