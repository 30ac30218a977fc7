"""Rules of control flow: `scan` and `cond`."""

from typing import Any

import jax
import jax.numpy as jnp

from .transform import at_a, at_b, increment, moves, Moving, NoRule, Switching, Value


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
    """The rule of the branch that both points take; none where they part."""
    walk, branches = params["walk"], params["branches"]
    which, *operands = values
    if moves(which) or any(isinstance(v, Switching) for v in operands):
        raise NoRule

    def branch(program):
        def run(operands: list[Value]) -> list[Value]:
            outs = walk.closed(program, operands)
            if any(isinstance(v, Switching) for v in outs):
                raise NoRule
            return [
                Moving(at_a(v), at_b(v), increment(v))
                if jnp.issubdtype(jnp.result_type(at_a(v)), jnp.inexact)
                else v
                for v in outs
            ]

        return run

    return jax.lax.switch(which, [branch(program) for program in branches], operands)
