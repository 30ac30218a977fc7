"""Rules of control flow: `scan` and `cond`."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .arithmetic import both
from .choices import share
from .transform import at_a, at_b, increment, Moving, NoRule, Switching, Value


def scan(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """A scan over the rule of its body, the increment carried along."""
    walk, body = params["walk"], params["jaxpr"]
    num_consts, num_carry = params["num_consts"], params["num_carry"]
    if any(isinstance(v, Switching) for v in values):
        raise NoRule
    consts, carry = values[:num_consts], values[num_consts : num_consts + num_carry]
    xs = values[num_consts + num_carry :]
    # What starts still may move later: carry an increment wherever there can be one.
    floating = [jnp.issubdtype(jnp.result_type(at_a(c)), jnp.inexact) for c in carry]
    begin = [
        Moving(at_a(c), at_b(c), increment(c)) if f else c
        for c, f in zip(carry, floating, strict=True)
    ]

    def one(carry: list[Value], xs: list[Value]):
        outs = walk.closed(body, [*consts, *carry, *xs])
        if any(isinstance(v, Switching) for v in outs):
            raise NoRule
        after = [
            Moving(at_a(c), at_b(c), increment(c)) if f else c
            for c, f in zip(outs[:num_carry], floating, strict=True)
        ]
        return after, outs[num_carry:]

    after, ys = jax.lax.scan(
        one,
        begin,
        xs,
        length=params["length"],
        reverse=params["reverse"],
        unroll=params["unroll"],
    )
    return [*after, *ys]


def cond(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """The rule of the branch that both points take; the true quotient where they part."""
    walk, branches = params["walk"], params["branches"]
    which, *operands = values
    if any(isinstance(v, Switching) for v in operands):
        raise NoRule
    inexact = [jnp.issubdtype(x.dtype, jnp.inexact) for x in branches[0].out_avals]

    def branch(program):
        def run(operands: list[Value]) -> list[Value]:
            outs = walk.closed(program, operands)
            if any(isinstance(v, Switching) for v in outs):
                raise NoRule
            return [
                Moving(at_a(v), at_b(v), increment(v)) if f else v
                for v, f in zip(outs, inexact, strict=True)
            ]

        return run

    runs = [branch(program) for program in branches]
    if not isinstance(which, Switching):
        return jax.lax.switch(which, runs, operands)
    if not all(inexact):
        raise NoRule
    ends = both(values, params)

    def together(operands: list[Value]) -> list[Array]:
        return [out.d for out in jax.lax.switch(which.a, runs, operands)]

    def apart(operands: list[Value]) -> list[Array]:
        del operands
        squares, decided = jnp.sum(which.squares), jnp.sum(which.decided)
        return [share(b - a, squares, decided) for a, b in ends]

    increments = jax.lax.cond(which.a == which.b, together, apart, operands)
    return [Moving(a, b, d) for (a, b), d in zip(ends, increments, strict=True)]
