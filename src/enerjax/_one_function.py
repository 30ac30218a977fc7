"""Computations of small systems as one function of machine code, on CPUs.

These are loops over steps and, where derivatives are taken, the search for a root and the
inverse at it. XLA's CPU back end calls a function for each of the hundred or so array
operations of a step, and the calls take longer than the operations. It has a remedy for
small loops (see `_fast_loops.py`), which compiles all of a computation into one function,
and it takes any call that is marked as one of these. Not every operation is possible
inside: only those which need nothing from the runtime.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlib
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun
from jaxtyping import Array, PyTree

from ._tracing import programs_within
from ._types import Scalar


# The marks are those of these versions. Others would not know them, or not keep to them.
_KNOWS_MARKS = (0, 10, 2) <= jaxlib.version.__version_info__ < (0, 11)
_MARKS = {"xla_cpu_small_call": "true", "inlineable": "false"}

# Entries of what is summed, above which XLA calls a library; here with room to spare.
LARGEST_SUM = 2048
# Rows or columns from which it does for products of matrices.
_THIN = 8

_CALLS = """
    jit remat2 custom_jvp_call custom_vjp_call custom_vmap_call while cond scan
    xla_metadata_value
"""
_MOVES = """
    broadcast_in_dim concatenate copy dynamic_slice dynamic_update_slice gather iota pad
    platform_index reshape rev select_n slice split squeeze stack stop_gradient transpose
    unstack
"""
_ELEMENTWISE = """
    abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp
    convert_element_type cos cosh digamma div eq erf erf_inv erfc exp exp2 expm1 floor ge gt
    integer_pow is_finite le lgamma log log1p logistic lt max min mul name ne neg nextafter
    not or population_count pow rem round rsqrt shift_left shift_right_arithmetic
    shift_right_logical sign sin sinh sqrt square sub tan tanh xor
"""
_SUMS = "argmax argmin reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum"
_POSSIBLE = frozenset((_CALLS + _MOVES + _ELEMENTWISE).split())
_POSSIBLE_IF_SMALL = frozenset(_SUMS.split())


def unmerged(fn: Callable[..., tuple[Array, ...]]) -> Callable[..., tuple[Array, ...]]:
    """`fn`, whose operations XLA does not merge with those around it.

    Where one operation needs an entry of another several times, merging computes it as
    often. The same values either way. `fn` must return two arrays or more: XLA would share
    the work of a call with one result among threads, which is not possible inside of one
    function. Not to be differentiated.
    """
    if not _marks():
        return fn
    call = jax.jit(fn)

    def apart(*args: Array) -> tuple[Array, ...]:
        first, *others = call(*args)
        # The mark goes to what made the value: the call.
        first: Any = set_xla_metadata(first, inlineable=_MARKS["inlineable"])
        return first, *others

    return apart


def in_one_function(fn: Callable[..., PyTree[Array]]) -> Callable[..., PyTree[Array]]:
    """`fn`, between trees of arrays, as one function of machine code where it can be.

    The same values either way. The lanes of a batch run one after the other, each with the
    iterations that it needs. Derivatives are compiled as usual.
    """
    if not _marks():
        return fn

    def call(*args: PyTree[Array]) -> PyTree[Array]:
        closed, like = jax.make_jaxpr(fn, return_shape=True)(*args)
        # Not the closed one: its constants can be traced, and would outlive their trace.
        jaxpr, count = closed.jaxpr, len(closed.consts)

        def program(*numbers: Array) -> list[Array]:
            again = ClosedJaxpr(jaxpr, numbers[:count])
            return jaxpr_as_fun(again)(*numbers[count:])

        # What `fn` closes over is an input of its own.
        numbers = tuple(map(jnp.asarray, (*closed.consts, *jax.tree.leaves(args))))
        possible = len(numbers) > 0 and _is_possible(jaxpr)
        out = (_call if possible else _plain)(program, numbers)
        return jax.tree.unflatten(jax.tree.structure(like), out)

    return call


def _plain(program: Callable[..., list[Array]], numbers: tuple[Array, ...]) -> list[Array]:
    return program(*numbers)


@eqx.filter_custom_jvp
def _call(program: Callable[..., list[Array]], numbers: tuple[Array, ...]) -> list[Array]:
    one = jax.custom_batching.custom_vmap(functools.partial(_marked, program))

    @one.def_vmap
    def lanes(axis_size, in_batched, *numbers):  # pyright: ignore[reportUnusedFunction]
        # One after the other: for few lanes the calls of the operations take longer than
        # all of a lane, and many do not fit into the cache.
        del axis_size
        if not any(in_batched):
            # Of a batch whose lanes differ elsewhere. (To call `one` would lead back here.)
            out = program(*numbers)
            return out, [False] * len(out)
        own, shared = eqx.partition(numbers, tuple(in_batched))
        out = jax.lax.map(lambda lane: one(*eqx.combine(lane, shared)), own)
        return out, [True] * len(out)

    return one(*numbers)


@_call.def_jvp
def _call_jvp(primals, tangents):
    out, rates = eqx.filter_jvp(_plain, primals, tangents)
    # Under `vmap` JAX takes the axis of the lanes from the function itself, for what this
    # rule returns too, and does not compare: there it is the first one, of every output.
    # Here a loop puts it second, and an output can have none. (Rates follow their values.)
    sign = jax.lax.stop_gradient(_witness(primals[1]))

    def lanes_first(x: Array) -> Array:
        x = jnp.where(sign > 0, x, x)
        # A change of shape has the lanes first.
        return jax.lax.reshape(jax.lax.reshape(x, (1, *x.shape)), x.shape)

    return list(map(lanes_first, out)), rates


def _marked(program: Callable[..., list[Array]], *numbers: Array) -> list[Array]:
    # XLA ends the process where an input of such a function is not used: what is empty is
    # made inside, and of all others a number goes into a witness.
    def with_witness(*inputs):
        left = iter(inputs)
        made = lambda x: next(left) if x.size else jnp.zeros(x.shape, x.dtype)
        return program(*map(made, numbers)), _witness(inputs)

    # Nor may it see that one is a constant, which it would put inside instead of the input;
    # and for one of more than 10 kB (a table that is looked up) it has no address there.
    inputs = jax.lax.optimization_barrier([x for x in numbers if x.size])
    out, sign = jax.jit(with_witness)(*inputs)
    # The marks go to what made the value: the call.
    witness: Any = set_xla_metadata(sign, **_MARKS)
    # Nothing here may find that the witness is not needed.
    return [jnp.where(witness > 0, out[0], out[0]), *out[1:]]


def _marks() -> bool:
    return _KNOWS_MARKS and jax.default_backend() == "cpu"


def _witness(arrays: Sequence[Array]) -> Scalar:
    """A number to which each of some arrays contributes."""
    first = lambda x: jax.lax.slice(x, (0,) * x.ndim, tuple(min(n, 1) for n in x.shape))
    parts = (jnp.real(jnp.sum(first(x))).astype(float) for x in arrays)
    return functools.reduce(jnp.add, parts, jnp.zeros(()))


def _is_possible(jaxpr: Jaxpr) -> bool:
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name in _POSSIBLE_IF_SMALL:
            possible = all(x.aval.size <= LARGEST_SUM for x in eqn.invars)  # pyright: ignore
        elif name == "dot_general":
            possible = _is_small_product(eqn)
        else:
            possible = name in _POSSIBLE
        if not possible or not all(map(_is_possible, programs_within(eqn))):
            return False
    return True


def _is_small_product(eqn: Any) -> bool:
    """Whether XLA writes out a product, instead of calling a library."""
    sizes = [x.aval.shape for x in eqn.invars]
    contracted, batch = eqn.params["dimension_numbers"]
    left, right = (
        [n for k, n in enumerate(shape) if k not in (*used, *of_batch)]
        for shape, used, of_batch in zip(sizes, contracted, batch, strict=True)
    )
    if max(x.aval.size for x in eqn.invars) > LARGEST_SUM:
        return False
    is_thin = max((*sizes[0], *sizes[1]), default=1) < _THIN
    return is_thin or not left or not right
