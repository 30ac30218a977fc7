"""A primitive of JAX that runs a program as one function of machine code, on CPUs.

On other processors, and where an operation has no machine code here, XLA compiles the
program. The values are the same, but for round-off. Derivatives of a program are programs
of this kind too; `jax.checkpoint` decides which values they keep.
"""

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from contextvars import ContextVar
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun, Literal, Primitive
from jax.interpreters import ad, batching, mlir
from jax.interpreters.partial_eval import dce_jaxpr_consts
from jaxtyping import Array, PyTree

from ..garbage import few_searches_for_garbage
from ..jaxprs import known_numbers, with_constants_as_inputs
from ..known_indices import known_indices
from .evaluation import NAME
from .library import compiled_function, Function, graph_of
from .values import Unsupported


Arguments = ParamSpec("Arguments")
Value = TypeVar("Value")

# The first version of jaxlib whose interface for functions of others was tried.
_SINCE = (0, 10)
# The most numbers that a function returns: their places are tables while it is compiled.
_MOST_RESULTS = 4_000_000
# The lanes of a batch are computed by several calls if their results are more numbers.
_MOST_OF_LANES = 1_000_000


_left_to_xla = ContextVar("left to XLA", default=False)


def left_to_xla(fn: Callable[Arguments, Value]) -> Callable[Arguments, Value]:
    """`fn` without functions of machine code, for a program that runs once.

    Without optimisation XLA compiles it sooner: the start of 16 hinged bodies takes 9 s,
    and 16 s with functions of machine code.
    """

    @functools.wraps(fn)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Value:
        before = _left_to_xla.set(True)
        try:
            return fn(*args, **kwargs)
        finally:
            _left_to_xla.reset(before)

    return call


def in_one_function(fn: Callable[..., PyTree[Array]]) -> Callable[..., PyTree[Array]]:
    """`fn`, between trees of arrays, as one function of machine code where it can be.

    The values are the same either way, but for round-off. Several lanes of a
    batch are computed at a time, and each has the iterations that it needs.
    """
    return functools.partial(_called, fn, False)


def part(fn: Callable[..., PyTree[Array]]) -> Callable[..., PyTree[Array]]:
    """`in_one_function(fn)` for a part of a program that may be one function as a whole.

    It is a function of its own only if the whole is none.
    """
    return functools.partial(_called, fn, True)


def why_not_one_function(
    fn: Callable[..., PyTree[Array]], *args: PyTree[Array]
) -> tuple[str, ...]:
    """What keeps `fn(*args)` from being one function, and its line.

    The result is empty if it can be one function.
    """
    closed = jax.make_jaxpr(fn)(*args)
    known = [*map(known_numbers, closed.consts), *[None] * len(closed.jaxpr.invars)]
    try:
        graph_of(closed.jaxpr, known)
    except Unsupported as obstacle:
        return (str(obstacle),)
    return ()


def _called(fn: Callable[..., PyTree[Array]], is_part: bool, *args: PyTree[Array]) -> Any:
    if _left_to_xla.get():
        return fn(*args)
    # The text of a method would have all arrays of its object.
    named = lambda *args: fn(*args)
    closed, like = jax.make_jaxpr(named, return_shape=True)(*args)
    inputs = jax.tree.leaves(args)
    if sum(x.size for x in closed.out_avals) > _MOST_RESULTS:
        out = jaxpr_as_fun(closed)(*inputs)
    else:
        out = run_closed(closed, inputs, [True] * len(closed.out_avals), is_part)
    return jax.tree.unflatten(jax.tree.structure(like), map(jnp.asarray, out))


class Program:
    """A program as the parameter of a primitive.

    - `jaxpr`: its first inputs are constants. They can be traced, and a program that held
      them would outlive their trace.
    - `known`: the values of those inputs that are known; `None` for the others.
    - `is_part`: whether the program is a part of a larger one. If the larger one is one
      function, the part is not a function of its own.
    - `linear`: the number of inputs, the last ones, that the program is linear in.
    """

    def __init__(
        self,
        jaxpr: Any,
        known: Sequence[np.ndarray | None],
        is_part: bool = False,
        linear: int = 0,
    ):
        self.jaxpr, self.known = jaxpr, known
        self.is_part, self.linear = is_part, linear
        self.is_evaluated = False
        # Evaluations outside of other programs share one compilation.
        self.compiled = jax.jit(lambda *numbers: list(self.bind(numbers)))

    def bind(self, numbers: Sequence[Array]) -> list[Array]:
        return ONE_FUNCTION.bind(*numbers, program=self)

    @functools.cached_property
    @few_searches_for_garbage()
    def function(self) -> Function | Unsupported:
        """The function of machine code, or the reason why there is none."""
        if jaxlib.version.__version_info__ < _SINCE:
            return Unsupported("this version of jaxlib")
        try:
            return compiled_function(self.jaxpr, self.known)
        except Unsupported as reason:
            return reason

    def __call__(self, numbers: Sequence[Array]) -> list[Array]:
        """The outputs, computed by operations of JAX."""
        pairs = zip(numbers, self.known, strict=True)
        values = [x if known is None else known for x, known in pairs]
        return jaxpr_as_fun(ClosedJaxpr(self.jaxpr, ()))(*values)

    def run(self, numbers: Sequence[Array]) -> list[Array]:
        """The outputs, computed by machine code where that is possible."""
        function = self.function
        if not isinstance(function, Function):
            return self(numbers)
        pairs = zip(numbers, self.known, strict=True)
        taken = [x for x, known in pairs if known is None]
        like = [
            jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in self.jaxpr.outvars
        ]
        return list(jax.ffi.ffi_call(function.name, like)(*taken))


def run_closed(
    closed: ClosedJaxpr,
    inputs: Sequence[Any],
    wanted: Sequence[bool],
    is_part: bool,
    linear: int = 0,
) -> list[Any]:
    """The wanted outputs of a program, in one function where that is possible.

    The others are `None`. An input that is an output too is returned without a copy.
    """
    numbers = [*closed.consts, *inputs]
    variables = (*closed.jaxpr.constvars, *closed.jaxpr.invars)
    inputs_by_id = {id(x): number for x, number in zip(variables, numbers, strict=True)}
    inputs_by_id |= _tables(closed.jaxpr, zip(variables, numbers, strict=True))
    handed_through = [id(x) in inputs_by_id for x in closed.jaxpr.outvars]
    computed = [on and not same for on, same in zip(wanted, handed_through, strict=True)]
    out = []
    if any(computed):
        jaxpr, of_consts, of_inputs = dce_jaxpr_consts(closed.jaxpr, computed)
        needed, _ = _split([*of_consts, *of_inputs], numbers)
        num_linear = sum(of_inputs[len(of_inputs) - linear :]) if linear else 0
        # Only constants have the same values in every call. Whole numbers among the inputs
        # are the places of tables.
        num_consts = sum(of_consts)
        known = [
            known_numbers(x) if k < num_consts else _known_places(x)
            for k, x in enumerate(needed)
        ]
        jaxpr = with_constants_as_inputs(jaxpr)
        program = Program(jaxpr, known, is_part, num_linear)
        out = program.bind(list(map(jnp.asarray, needed)))
    _, variables = _split(computed, closed.jaxpr.outvars)
    _, asked = _split(computed, wanted)
    pairs = zip(variables, asked, strict=True)
    return _merged(computed, out, [inputs_by_id[id(x)] if on else None for x, on in pairs])


def _tables(jaxpr: Any, inputs: Iterable[tuple[Any, Any]]) -> dict[int, np.ndarray]:
    """The outputs that are tables of indices with known values, by their identities.

    Numbers of a weak type are left out, because arrays of NumPy have none.
    """
    outputs = [x for x in jaxpr.outvars if not isinstance(x, Literal)]
    outputs = [x for x in outputs if not x.aval.weak_type]
    is_table = lambda x: x.aval.ndim and jnp.issubdtype(x.aval.dtype, jnp.integer)
    if not any(map(is_table, outputs)):
        return {}
    places = {variable: _known_places(x) for variable, x in inputs}
    known = known_indices(jaxpr, {v: x for v, x in places.items() if x is not None})
    return {id(x): known[x] for x in outputs if x in known}


def _known_places(x: Any) -> np.ndarray | None:
    """An array of whole numbers, if their values are known."""
    if jnp.ndim(x) == 0 or jnp.issubdtype(x.dtype, jnp.inexact):
        return None
    return known_numbers(x)


# The rules of the primitive ---------------------------------------------------------------


def _evaluated(*numbers: Array, program: Program) -> list[Array]:
    # With `jax_disable_jit` another `jit` would come back here, and so does JAX itself, in
    # its search for NaNs.
    without_jit = jax.config.jax_disable_jit  # pyright: ignore[reportAttributeAccessIssue]
    if without_jit or program.is_evaluated:
        return program(numbers)
    program.is_evaluated = True
    try:
        return program.compiled(*numbers)
    finally:
        program.is_evaluated = False


def _shapes(*_: Any, program: Program) -> list[Any]:
    return [x.aval for x in program.jaxpr.outvars]


def _has_rate(tangent: Any) -> bool:
    """Whether the rate of an input is not zero by its structure."""
    return not isinstance(tangent, ad.Zero)


@few_searches_for_garbage()
def _jvp(primals: Any, tangents: Any, *, program: Program) -> tuple[list, list]:
    """Values in one function, with the residuals of the linearisation; rates in another."""
    has_tangent = list(map(_has_rate, tangents))
    moved, _ = _split(has_tangent, tangents)
    smooth = [jnp.issubdtype(x.aval.dtype, jnp.inexact) for x in program.jaxpr.outvars]

    def linearised(*numbers):
        own, still = _split(has_tangent, numbers)
        values = lambda *own: _split(smooth, program(_merged(has_tangent, own, still)))
        return jax.linearize(values, *own, has_aux=True)

    closed, like = jax.make_jaxpr(linearised, return_shape=True)(*primals)
    pushed = jax.make_jaxpr(lambda push, moved: push(*moved))(like[1], moved)
    depends = _depends(pushed, len(moved))
    _, _, uses = dce_jaxpr_consts(pushed.jaxpr, depends)
    # The outputs of `closed`: values, residuals that the rates need, values without rates.
    num_values, num_others = sum(smooth), len(smooth) - sum(smooth)
    num_kept = len(closed.out_avals) - len(smooth)
    wanted = [True] * num_values + uses[:num_kept] + [True] * num_others
    out = run_closed(closed, primals, wanted, program.is_part)
    kept = out[num_values : num_values + num_kept]
    rates = run_closed(pushed, [*kept, *moved], depends, program.is_part, len(moved))
    out = _merged(smooth, out[:num_values], out[num_values + num_kept :])
    rates = _merged(smooth, rates, [None] * num_others)
    zeros = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in out]
    return out, [z if x is None else x for x, z in zip(rates, zeros, strict=True)]


def _depends(closed: ClosedJaxpr, linear: int) -> list[bool]:
    """Which outputs of a program depend on its last `linear` inputs."""
    jaxpr: Any = closed.jaxpr
    on = {id(x) for x in jaxpr.invars[len(jaxpr.invars) - linear :]}
    for eqn in jaxpr.eqns:
        if any(id(x) in on for x in eqn.invars):
            on.update(id(x) for x in eqn.outvars)
    return [id(x) in on for x in jaxpr.outvars]


@few_searches_for_garbage()
def _transpose(cotangents: Any, *numbers: Any, program: Program) -> list:
    wanted = [ad.is_undefined_primal(x) for x in numbers]
    unknown, known = _split(wanted, numbers)
    has_cotangent = [not isinstance(ct, ad.Zero) for ct in cotangents]
    cotangents, _ = _split(has_cotangent, cotangents)

    def pulled(known, cotangents):
        push = lambda *own: _split(has_cotangent, program(_merged(wanted, own, known)))[0]
        return jax.linear_transpose(push, *(x.aval for x in unknown))(cotangents)

    closed = jax.make_jaxpr(pulled)(known, cotangents)
    depends = _depends(closed, len(cotangents))
    inputs = [*known, *cotangents]
    out = run_closed(closed, inputs, depends, program.is_part, len(cotangents))
    zeros = [ad.Zero(x.aval) for x in unknown]
    out = [x if on else zero for on, x, zero in zip(depends, out, zeros, strict=True)]
    return _merged(wanted, out, [None] * len(known))


def _lanes(numbers: Any, axes: Any, *, program: Program) -> tuple[list, list[int]]:
    batched = [axis is not None for axis in axes]
    moved = [
        x if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(numbers, axes, strict=True)
    ]
    own, shared = _split(batched, moved)
    out = _of_lanes(program, own, shared, batched)
    return out, [0] * len(out)


def _of_lanes(
    program: Program, own: list[Array], shared: list[Array], batched: list[bool]
) -> list[Array]:
    """The outputs for all lanes. On CPUs each has the iterations that it needs."""
    of_lane = lambda own: program(_merged(batched, own, shared))
    if any(map(_is_sharded, own)):
        # Each device computes its own lanes.
        return jax.vmap(of_lane)(own)
    still = len(batched) - program.linear
    if program.linear and not any(batched[:still]):
        # Many directions at one point share everything but the directions themselves.
        closed = jax.make_jaxpr(jax.vmap(of_lane))(own)
        wanted = [True] * len(closed.out_avals)
        return run_closed(closed, own, wanted, program.is_part, len(own))
    in_turn = lambda own: _in_turn(program, of_lane, own)
    if jax.default_backend() == "cpu":
        return in_turn(own)
    # Other processors would take the lanes one by one there.
    return jax.lax.platform_dependent(own, cpu=in_turn, default=jax.vmap(of_lane))


def _in_turn(
    program: Program, of_lane: Callable[[list[Array]], list[Array]], own: list[Array]
) -> list[Array]:
    """The outputs for all lanes, by a loop that makes several passes at a time."""
    closed = lambda own: jax.make_jaxpr(lambda own: jax.lax.map(of_lane, own))(own)
    run = lambda own: run_closed(closed(own), own, wanted, program.is_part)
    wanted, lanes = [True] * len(program.jaxpr.outvars), len(own[0])
    size = sum(math.prod(x.aval.shape) for x in program.jaxpr.outvars)
    chunks = -(-lanes * max(size, 1) // _MOST_OF_LANES)
    if chunks <= 1:
        return run(own)
    # All chunks are calls of one program: the last one overlaps the one before it.
    length = -(-lanes // chunks)
    starts = np.minimum(length * np.arange(-(-lanes // length)), lanes - length)
    chunk = lambda first, x: jax.lax.dynamic_slice_in_dim(x, first, length)
    chunk_of_all = lambda first: [chunk(first, x) for x in own]
    out = jax.lax.map(lambda first: run(chunk_of_all(first)), jnp.asarray(starts))
    number = np.minimum(np.arange(lanes) // length, starts.size - 1)
    return [x[number, np.arange(lanes) - starts[number]] for x in out]


def _is_sharded(x: Array) -> bool:
    """Whether an array is sharded over axes of a mesh that its type names."""
    return any(axis is not None for axis in jax.typeof(x).sharding.spec)


def _lowered_for_cpu(*numbers: Array, program: Program) -> list[Array]:
    return program.run(numbers)


def _lowered(*numbers: Array, program: Program) -> list[Array]:
    return program(numbers)


def _new_primitive() -> Primitive:
    primitive = Primitive(NAME)
    primitive.multiple_results = True
    primitive.def_impl(_evaluated)
    primitive.def_abstract_eval(_shapes)
    ad.primitive_jvps[primitive] = _jvp
    ad.primitive_transposes[primitive] = _transpose
    batching.primitive_batchers[primitive] = _lanes
    mlir.register_lowering(primitive, mlir.lower_fun(_lowered))
    mlir.register_lowering(primitive, mlir.lower_fun(_lowered_for_cpu), platform="cpu")
    return primitive


ONE_FUNCTION = _new_primitive()


def _split(which: Sequence[bool], values: Sequence[Any]) -> tuple[list, list]:
    pairs = list(zip(which, values, strict=True))
    return [x for on, x in pairs if on], [x for on, x in pairs if not on]


def _merged(which: Sequence[bool], chosen: Sequence[Any], rest: Sequence[Any]) -> list:
    """The inverse of `_split`."""
    first, others = iter(chosen), iter(rest)
    return [next(first if on else others) for on in which]
