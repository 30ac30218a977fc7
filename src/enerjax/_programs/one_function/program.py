"""A primitive of JAX that runs a program as one function, as its derivatives are run."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun, Primitive
from jax.interpreters import ad, batching, mlir
from jax.interpreters.partial_eval import dce_jaxpr_consts
from jaxtyping import Array, PyTree

from ..counting import num_equations
from ..jaxprs import known_numbers
from .marks import marked
from .possible import has_parts, is_possible, longest, NAME
from .rewriting import as_index, REWRITTEN, rewritten


if TYPE_CHECKING:
    from ..entrywise import ProgramInLanes


def call(
    fn: Callable[..., PyTree[Array]],
    is_part: bool,
    side_by_side: Any,
    *args: PyTree[Array],
) -> PyTree[Array]:
    """`fn(*args)` in one function, if it can be; see `in_one_function`."""
    closed, like = jax.make_jaxpr(fn, return_shape=True)(*args)
    wanted = [True] * len(closed.out_avals)
    lanes = None
    if side_by_side is not None:
        lanes = jax.make_jaxpr(side_by_side.fn)(*args), side_by_side
    out = run_closed(closed, jax.tree.leaves(args), wanted, is_part, in_lanes=lanes)
    return jax.tree.unflatten(jax.tree.structure(like), map(jnp.asarray, out))


class Program:
    """A program as the parameter of a primitive.

    - `jaxpr`: its constants are passed as the first inputs. They can be traced, and a
      program that held them would outlive their trace.
    - `known`: the values of those inputs that are known indices; `None` for the others.
    - `is_part`: whether the program is a part of a larger one. If the larger one is one
      function, the part is not a function of its own.
    - `linear`: the number of inputs, the last ones, that the program is linear in.
    - `in_lanes`: a program for many lanes with the same results, if there is one. Its
      inputs follow those of the program.
    """

    def __init__(
        self,
        jaxpr: Any,
        known: Sequence[np.ndarray | None],
        is_part: bool = False,
        linear: int = 0,
        in_lanes: "InLanes | None" = None,
    ):
        self.in_lanes = in_lanes
        self.jaxpr = jaxpr
        self.is_part = is_part
        self.known = known
        self.linear = linear
        # Evaluations outside of other programs share one compilation.
        self.compiled = jax.jit(lambda *numbers: self.run(numbers))

    @functools.cached_property
    def function(self) -> Any:
        """The function of machine code, or the reason why there is none."""
        from ..machine_code import compiled_function, Unsupported

        try:
            return compiled_function(self.jaxpr, self.known)
        except Unsupported as reason:
            return reason

    def run(self, numbers: Sequence[Array]) -> list[Array]:
        """The outputs, computed in one function where that is possible."""
        from ..machine_code import Function

        function = self.function
        if not isinstance(function, Function):
            return self(numbers)
        pairs = zip(numbers, self.known, strict=True)
        taken = [x for x, known in pairs if known is None]
        like = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in self.jaxpr.outvars]
        return jax.ffi.ffi_call(function.name, like)(*taken)

    def own(self, numbers: Any) -> Any:
        """The inputs of the program itself, of all inputs of the primitive."""
        return numbers[: len(self.known)]

    def __call__(self, numbers: Sequence[Array]) -> list[Array]:
        pairs = zip(numbers, self.known, strict=True)
        return _values(self.jaxpr, [x if known is None else known for x, known in pairs])


class InLanes:
    """A program for many lanes, which may fail for some of them.

    - `jaxpr`: its outputs are those of the other program, and whether it has failed. Its
      constants are passed as the first inputs.
    - `known`: the values of the inputs that are known; `None` for those that are passed.
    - `fewest`, `if_long`: when it is used; see `SideBySide`.
    """

    def __init__(
        self,
        closed: ClosedJaxpr,
        numbers: Sequence[Any],
        wanted: Sequence[bool],
        when: Any,
    ):
        self.fewest, self.if_long = when.fewest, when.if_long
        self.jaxpr, of_consts, of_inputs = dce_jaxpr_consts(closed.jaxpr, [*wanted, True])
        needed, _ = split([*of_consts, *of_inputs], [*closed.consts, *numbers])
        self.known = list(map(known_numbers, needed))
        pairs = zip(needed, self.known, strict=True)
        self.numbers = [x for x, known in pairs if known is None]

    @functools.cached_property
    def function(self) -> "ProgramInLanes | None":
        """The program, entry by entry, of its inputs that are not known; if possible."""
        from ..entrywise import in_lanes

        return in_lanes(self.jaxpr, self.known)


def _values(jaxpr: Any, numbers: Sequence[Any]) -> list[Array]:
    """The outputs of a program whose constants are the first of the numbers."""
    count = len(jaxpr.constvars)
    return jaxpr_as_fun(ClosedJaxpr(jaxpr, list(numbers[:count])))(*numbers[count:])


def run_closed(
    closed: ClosedJaxpr,
    inputs: Sequence[Any],
    wanted: Sequence[bool],
    is_part: bool,
    linear: int = 0,
    in_lanes: tuple[ClosedJaxpr, Any] | None = None,
) -> list[Any]:
    """The wanted outputs of a program, in one function where that is possible.

    The others are `None`. An input that is an output too is returned without a copy.
    """
    numbers = [*closed.consts, *inputs]
    variables = (*closed.jaxpr.constvars, *closed.jaxpr.invars)
    inputs_by_id = {id(x): number for x, number in zip(variables, numbers, strict=True)}
    handed_through = [id(x) in inputs_by_id for x in closed.jaxpr.outvars]
    computed = [on and not same for on, same in zip(wanted, handed_through, strict=True)]
    jaxpr, of_consts, of_inputs = dce_jaxpr_consts(closed.jaxpr, computed)
    needed, _ = split([*of_consts, *of_inputs], numbers)
    linear = sum(of_inputs[len(of_inputs) - linear :])
    lanes, more = None, []
    if in_lanes is not None:
        other, when = in_lanes
        lanes = InLanes(other, inputs, computed, when)
        # They are passed on, and not kept: a program can outlive the trace of its inputs.
        more, lanes.numbers = lanes.numbers, []
    num_consts = sum(of_consts)
    known = [
        known_numbers(x) if k < num_consts else as_index(x) for k, x in enumerate(needed)
    ]
    program = Program(jaxpr, known, is_part, linear, lanes)
    needed = list(map(jnp.asarray, needed))
    if any(computed):
        out = ONE_FUNCTION.bind(*needed, *more, program=program)
    else:
        out = program(needed)
    _, variables = split(computed, closed.jaxpr.outvars)
    _, asked = split(computed, wanted)
    pairs = zip(variables, asked, strict=True)
    return merged(computed, out, [inputs_by_id[id(x)] if on else None for x, on in pairs])


def new_primitive(
    name: str,
    evaluated: Callable[..., list[Array]],
    shapes: Callable[..., list[Any]],
    jvp: Callable[..., tuple[list, list]],
    lowered: Callable[..., list[Array]],
) -> Primitive:
    """A primitive with several results, and the rules by which JAX treats it."""
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(evaluated)
    primitive.def_abstract_eval(shapes)
    ad.primitive_jvps[primitive] = jvp
    mlir.register_lowering(primitive, mlir.lower_fun(lowered))
    return primitive


def has_rate(tangent: Any) -> bool:
    """Whether the rate of an input is not zero by its structure."""
    return not isinstance(tangent, ad.Zero)


def no_rate(x: Any) -> Any:
    """The rate of a value that does not change."""
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def set_rule_for_batches(
    primitive: Primitive, rule: Callable[..., tuple[list, list[int]]]
) -> None:
    """`rule(numbers, axes, **params)` computes the primitive for all lanes of a batch."""
    batching.primitive_batchers[primitive] = rule


def _evaluated(*numbers: Array, program: Program) -> list[Array]:
    # With `jax_disable_jit`, as in the search for NaNs, another `jit` would come back here.
    is_apart = jax.config.jax_disable_jit  # pyright: ignore[reportAttributeAccessIssue]
    numbers = program.own(numbers)
    return program(numbers) if is_apart else program.compiled(*numbers)


def _shapes(*_: Any, program: Program) -> list[Any]:
    return [x.aval for x in program.jaxpr.outvars]


def _jvp(primals: Any, tangents: Any, *, program: Program) -> tuple[list, list]:
    """Values in one function, with the residuals of the linearisation; rates in another."""
    primals, tangents = program.own(primals), program.own(tangents)
    has_tangent = list(map(has_rate, tangents))
    moved, _ = split(has_tangent, tangents)
    smooth = [jnp.issubdtype(x.aval.dtype, jnp.inexact) for x in program.jaxpr.outvars]

    def linearised(*numbers):
        own, still = split(has_tangent, numbers)
        values = lambda *own: split(smooth, program(merged(has_tangent, own, still)))
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
    out = merged(smooth, out[:num_values], out[num_values + num_kept :])
    rates = merged(smooth, rates, [None] * num_others)
    zeros = list(map(no_rate, out))
    return out, [z if x is None else x for x, z in zip(rates, zeros, strict=True)]


def _depends(closed: ClosedJaxpr, linear: int) -> list[bool]:
    """Which outputs of a program depend on its last `linear` inputs."""
    jaxpr: Any = closed.jaxpr
    on = {id(x) for x in jaxpr.invars[len(jaxpr.invars) - linear :]}
    for eqn in jaxpr.eqns:
        if any(id(x) in on for x in eqn.invars):
            on.update(id(x) for x in eqn.outvars)
    return [id(x) in on for x in jaxpr.outvars]


def _transpose(cotangents: Any, *numbers: Any, program: Program) -> list:
    wanted = [ad.is_undefined_primal(x) for x in numbers]
    unknown, known = split(wanted, numbers)
    has_cotangent = [not isinstance(ct, ad.Zero) for ct in cotangents]
    cotangents, _ = split(has_cotangent, cotangents)

    def pulled(known, cotangents):
        push = lambda *own: split(has_cotangent, program(merged(wanted, own, known)))[0]
        return jax.linear_transpose(push, *(x.aval for x in unknown))(cotangents)

    closed = jax.make_jaxpr(pulled)(known, cotangents)
    depends = _depends(closed, len(cotangents))
    inputs = [*known, *cotangents]
    out = run_closed(closed, inputs, depends, program.is_part, len(cotangents))
    zeros = [ad.Zero(x.aval) for x in unknown]
    out = [x if on else zero for on, x, zero in zip(depends, out, zeros, strict=True)]
    return merged(wanted, out, [None] * len(known))


def _lowered(*numbers: Array, program: Program) -> list[Array]:
    return program.run(program.own(numbers))


ONE_FUNCTION = new_primitive(NAME, _evaluated, _shapes, _jvp, _lowered)
ad.primitive_transposes[ONE_FUNCTION] = _transpose


def split(which: Sequence[bool], values: Sequence[Any]) -> tuple[list, list]:
    pairs = list(zip(which, values, strict=True))
    return [x for on, x in pairs if on], [x for on, x in pairs if not on]


def merged(which: Sequence[bool], chosen: Sequence[Any], rest: Sequence[Any]) -> list:
    """The inverse of `split`."""
    first, others = iter(chosen), iter(rest)
    return [next(first if on else others) for on in which]
