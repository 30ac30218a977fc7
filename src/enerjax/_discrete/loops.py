"""Rules of control flow: `scan` and `cond`."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._programs import parts_of_scan
from .arithmetic import both
from .piecewise import share
from .transform import (
    at_a,
    at_b,
    increment,
    Moving,
    NoRule,
    refuse_choices,
    Switching,
    Value,
)


def _with_increments(values: list[Value], inexact: list[bool]) -> list[Value]:
    """The values, of which inexact ones get an increment even if they do not differ."""
    return [
        Moving(at_a(v), at_b(v), increment(v)) if flag else v
        for v, flag in zip(values, inexact, strict=True)
    ]


def scan(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """A scan over the rule of its body, which carries the increment along."""
    walk, body = params["walk"], params["jaxpr"]
    num_consts, num_carry = parts_of_scan(params)
    refuse_choices(values)
    consts, carry = values[:num_consts], values[num_consts : num_consts + num_carry]
    xs = values[num_consts + num_carry :]
    # A carry that is the same at both points at first may differ later.
    inexact = [jnp.issubdtype(jnp.result_type(at_a(c)), jnp.inexact) for c in carry]

    def one(carry: list[Value], xs: list[Value]):
        outs = walk.closed(body, [*consts, *carry, *xs])
        refuse_choices(outs)
        return _with_increments(outs[:num_carry], inexact), outs[num_carry:]

    after, ys = jax.lax.scan(
        one,
        _with_increments(carry, inexact),
        xs,
        length=params["length"],
        reverse=params["reverse"],
        unroll=params["unroll"],
    )
    return [*after, *ys]


def cond(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """The rule of the branch if both points take the same; else the difference quotient."""
    walk, branches = params["walk"], params["branches"]
    which, *operands = values
    refuse_choices(operands)
    inexact = [jnp.issubdtype(x.dtype, jnp.inexact) for x in branches[0].out_avals]

    def branch(program):
        def run(operands: list[Value]) -> list[Value]:
            outs = walk.closed(program, operands)
            refuse_choices(outs)
            return _with_increments(outs, inexact)

        return run

    runs = [branch(program) for program in branches]
    if not isinstance(which, Switching):
        return jax.lax.switch(which, runs, operands)
    if not all(inexact):
        raise NoRule
    ends = both(values, params)

    def of_branch(operands: list[Value]) -> list[Array]:
        return [out.d for out in jax.lax.switch(which.a, runs, operands)]

    def of_difference(operands: list[Value]) -> list[Array]:
        del operands
        squares, decided = jnp.sum(which.squares), jnp.sum(which.decided)
        return [share(b - a, squares, decided) for a, b in ends]

    is_same = which.a == which.b
    increments = jax.lax.cond(is_same, of_branch, of_difference, operands)
    return [Moving(a, b, d) for (a, b), d in zip(ends, increments, strict=True)]
