"""Loops over lanes that compute the entries of a region."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .entries import Entry, Number
from .kernels import filled, kernel
from .loops import Scan, While
from .planning import Kernel, Plan


# The number of operations of one kernel: the time of compilation grows faster than that.
_LONGEST = 1_500

Values = dict[Entry, Array]


def computed(plan: Plan, known: Values, size: int) -> Values:
    """The values of the entries of a plan, for each of `size` lanes.

    `known` are the values of its inputs.
    """
    known = dict(known)
    for level, whole in enumerate(plan.kernels):
        for part in _parts(whole):
            if part.wanted:
                known.update(zip(part.wanted, kernel(*part, known), strict=True))
        if level < len(plan.loops):
            loop, body = plan.loops[level]
            if isinstance(loop, Scan):
                after = _scan(loop, body, known, size)
            else:
                after = _while(loop, body, known, size)
            known.update(zip(loop.after, after, strict=True))
    return known


def value_of(number: Number, known: Values, size: int) -> Array:
    return known[number] if isinstance(number, Entry) else filled(number, size)


def _parts(whole: Kernel) -> Iterator[Kernel]:
    """A kernel as kernels of moderate length."""
    entries, wanted = whole.entries, set(whole.wanted)
    count = -(-len(entries) // _LONGEST) or 1
    length = -(-len(entries) // count)
    parts = [entries[k * length : (k + 1) * length] for k in range(count)]
    for k, part in enumerate(parts):
        rest = (y for later in parts[k + 1 :] for x in later for y in x.operands)
        elsewhere = wanted.union(y for y in rest if isinstance(y, Entry))
        yield Kernel(part, [x for x in part if x in elsewhere])


def _while(loop: While, body: Plan, known: Values, size: int) -> list[Array]:
    before = [value_of(x, known, size) for x in loop.inputs]

    def one_pass(carry: list[Array]) -> list[Array]:
        now = known | dict(zip([*loop.carry, loop.active], carry, strict=True))
        now = computed(body, now, size)
        return [value_of(x, now, size) for x in loop.outputs]

    return jax.lax.while_loop(lambda carry: jnp.any(carry[-1]), one_pass, before)[:-1]


def _scan(loop: Scan, body: Plan, known: Values, size: int) -> list[Array]:
    before = [value_of(x, known, size) for x in loop.before]
    rows = [_rows(column, known, size) for _, column in loop.rows]

    def one_pass(carry: list[Array], row: list[Array]) -> tuple[list[Array], list[Array]]:
        now = known | dict(zip(loop.carry, carry, strict=True))
        entries = (entry for entry, _ in loop.rows)
        now |= {x: jnp.broadcast_to(y, (size,)) for x, y in zip(entries, row, strict=True)}
        now = computed(body, now, size)
        out = [value_of(x, now, size) for x in loop.outputs]
        return out[: len(carry)], out[len(carry) :]

    carry, stacked = jax.lax.scan(
        one_pass, before, rows, length=loop.length, reverse=loop.reverse
    )
    return [*carry, *stacked]


def _rows(column: list[Number], known: Values, size: int) -> Array:
    if not any(isinstance(x, Entry) for x in column):
        return jnp.array(column, column[0].dtype)
    return jnp.stack([value_of(x, known, size) for x in column])
