"""Indices whose values follow from the program, before it runs."""

from typing import Any

import jax
import numpy as np
from jax.extend.core import Literal

from .jaxprs import known_numbers
from .numpy_primitives import evaluated


# Larger tables are not computed: they would be constants of a megabyte in the program.
_MANY = 2**17


def known_indices(jaxpr: Any, inputs: dict[Any, np.ndarray]) -> dict[Any, np.ndarray]:
    """The variables that hold indices, and their values, where `inputs` determine them."""
    known = dict(inputs)
    for eqn in jaxpr.eqns:
        values = [
            np.asarray(x.val, x.aval.dtype)  # pyright: ignore
            if isinstance(x, Literal)
            else known.get(x)
            for x in eqn.invars
        ]
        if any(x is None for x in values):
            continue
        indices = computed_indices(eqn, values, _MANY)
        if indices is not None:
            known.update(zip(eqn.outvars, indices, strict=True))
    return known


def computed_indices(
    equation: Any, values: list[Any], most: int
) -> list[np.ndarray] | None:
    """The outputs of an equation that computes indices, if its inputs are known.

    `None` too if an output has more than `most` numbers.
    """
    avals = [x.aval for x in equation.outvars]
    if any(not is_index(x) or x.size > most for x in avals):
        return None
    known = [known_numbers(x) for x in values]
    # NumPy rounds numbers to indices in another way than XLA.
    if equation.effects or any(x is None or not is_index(x) for x in known):
        return None
    with jax.ensure_compile_time_eval():
        out = evaluated(equation.primitive, known, equation.params)
    return [np.asarray(x, aval.dtype) for x, aval in zip(out, avals, strict=True)]


def is_index(x: Any) -> bool:
    """Whether the entries of an array are indices or truth values."""
    return getattr(x.dtype, "kind", "key") in "iub"
