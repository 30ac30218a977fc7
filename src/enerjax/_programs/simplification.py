"""Programs without operations that are repeated, not used, or known while they are traced.

Known are the operations on indices. XLA leaves all of these out of the code that it
generates. Before that they are traced, derived and translated as often as their program
occurs in another one. Half of the operations of a residual are of this kind.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal
from jaxtyping import Array, PyTree

from .compiled import is_hashable
from .jaxprs import evaluate, interpret, known_numbers
from .known_indices import computed_indices


# Constants with more numbers than this are not compared, and such indices not computed.
_MANY = 4096


def simplified(fn: Callable[..., PyTree[Array]]) -> Callable[..., PyTree[Array]]:
    """`fn`, which returns a pytree of arrays, with every operation once."""

    def call(*args: Any) -> PyTree[Array]:
        numbers, rest = eqx.partition(args, eqx.is_array)
        leaves, structure = jax.tree.flatten(numbers)
        whole = lambda *leaves: fn(*eqx.combine(structure.unflatten(leaves), rest))
        closed, like = jax.make_jaxpr(whole, return_shape=True)(*leaves)
        rule = _Once(_needed(closed.jaxpr))
        out = interpret(closed.jaxpr, _shared(closed.consts), leaves, rule)
        return jax.tree.unflatten(jax.tree.structure(like), map(jnp.asarray, out))

    return call


def _shared(constants: list[Any]) -> list[Any]:
    """The constants of a program, with one array for all that are equal.

    A function that is called twice brings two copies of its tables, and operations on them
    would not be recognised as equal.
    """
    first: dict[Any, Any] = {}
    return [first.setdefault(_content(x), x) for x in constants]


def _content(constant: Any) -> Any:
    """Equal for arrays of equal numbers; the identity of a traced or a large array."""
    array = known_numbers(constant) if np.size(constant) <= _MANY else None
    if array is None:
        return id(constant)
    return array.tobytes(), array.shape, array.dtype, jnp.asarray(constant).weak_type


def _needed(jaxpr: Any) -> set[int]:
    """The identities of the equations on which the outputs depend."""
    used, needed = set(_variables(jaxpr.outvars)), set()
    for eqn in reversed(jaxpr.eqns):
        if eqn.effects or not used.isdisjoint(eqn.outvars):
            needed.add(id(eqn))
            used.update(_variables(eqn.invars))
    return needed


def _variables(atoms: Iterable[Any]) -> Iterator[Any]:
    return (x for x in atoms if not isinstance(x, Literal))


class _Once:
    """Evaluates an equation that is needed, unless it has evaluated an equal one."""

    def __init__(self, needed: set[int]):
        self._needed = needed
        # The values are kept, because the identity of one that is gone can be used again.
        self._found: dict[Any, tuple[list[Any], list[Any]]] = {}
        # Equal indices are one array, so that what uses them is found to be equal too.
        self._indices: dict[Any, np.ndarray] = {}

    def __call__(self, equation: Any, values: list[Any]) -> list[Any]:
        if id(equation) not in self._needed:
            return [None] * len(equation.outvars)
        primitive, params = equation.primitive, equation.params
        indices = computed_indices(equation, values, _MANY)
        if indices is not None:
            content = lambda x: (x.tobytes(), x.shape, x.dtype)
            return [self._indices.setdefault(content(x), x) for x in indices]
        key = primitive, tuple(params.items()), tuple(map(_identity, values))
        if equation.effects or not is_hashable(key):
            return evaluate(primitive, values, params)
        if key not in self._found:
            self._found[key] = evaluate(primitive, values, params), values
        return self._found[key][0]


def _identity(value: Any) -> Any:
    """Equal for a value and itself, and for equal literals."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        return value.tobytes(), value.dtype
    return id(value)
