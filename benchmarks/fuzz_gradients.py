"""Derivatives of short random runs: in reverse mode, forward mode and by differences.

All lanes of a batch are differentiated together; in a second call of the same program one
of them fails, and must leave the others as they were.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import fuzz_case as common
import jax
import jax.numpy as jnp
import numpy as np
from fuzz_case import Result
from jax.flatten_util import ravel_pytree
from numpy.random import Generator

import enerjax as ej


STEPS, LANES, EPS = 5, 4, 1e-4
SCHEMES: dict[str, Callable[[Any], ej.AbstractScheme]] = {
    "preserving": lambda a: ej.EnergyPreserving(),
    "consistent": ej.EnergyConsistent,
    "decaying": ej.EnergyDecaying,
    "composed 4": lambda a: ej.Composed(ej.EnergyPreserving(), 4),
    "preserving index3": lambda a: ej.EnergyPreserving("index3"),
    "decaying index3": lambda a: ej.EnergyDecaying(a, "index3"),
    "consistent 6": lambda a: ej.Composed(ej.EnergyConsistent(0.0), 6),
    "consistent zero": lambda a: ej.EnergyConsistent(0.0),
    "preserving gonzalez": lambda a: ej.EnergyPreserving(derivative=ej.Gonzalez()),
    "decaying gauss": lambda a: ej.EnergyDecaying(a, derivative=ej.MeanValue()),
    "rattle": lambda a: ej.Rattle(),
    "generalized": lambda a: ej.GeneralizedAlpha(1 - a),
    "generalized ggl": lambda a: ej.GeneralizedAlpha(1 - a, "ggl"),
    "kappa": ej.KappaDecaying,
}
# Schemes that need velocities that are the rates of the coordinates.
RATES_ONLY = (
    "consistent", "consistent 6", "consistent zero", "rattle", "generalized",
    "generalized ggl",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Family:
    """Systems that differ only in numbers, and how to draw `q`, `v`, `args` and `h`."""

    system: Any
    draw: Callable[[Generator], tuple[Any, Any, Any, float]]
    halvings: int = 0


def _net(rng: Generator):
    args = common.random_args(rng, 8, convex=False)
    return *common.random_start(rng, 8, args), args, rng.uniform(0.005, 0.03)


def _shake(rng: Generator, args: Any) -> Any:
    return jax.tree.map(lambda x: x * np.exp(0.03 * rng.normal(size=jnp.shape(x))), args)


def _turning(problem: Callable[[], Any], low: float, high: float):
    """A problem of the library with random numbers, start and step."""

    def draw(rng: Generator):
        _, start, args = problem()
        q = start.q + 0.01 * rng.normal(size=start.q.shape)
        v = start.v * rng.uniform(0.5, 1.5) + 0.3 * rng.normal(size=start.v.shape)
        return q, v, _shake(rng, args), rng.uniform(low, high)

    return draw


@functools.cache
def family(name: str) -> Family:
    p = ej.problems
    tops = dict(top=p.heavy_top, body=p.free_rigid_body, canonical=p.heavy_top_canonical)
    if name == "net":
        return Family(common.CONSTRAINED, _net)
    if name == "halved":
        # Steps in which links turn over.
        draw = _turning(p.double_pendulum, 0.2, 0.5)
        return Family(p.double_pendulum()[0], draw, 3)
    return Family(tops[name]()[0], _turning(tops[name], 0.001, 0.004))


def pairs() -> list[tuple[str, str]]:
    """Families in turn, each with the schemes that accept it, some with divided steps."""
    turning = [name for name in reversed(SCHEMES) if name not in RATES_ONLY]
    by_family = {
        "halved": ["preserving", "decaying", "consistent"],
        "top": ["decaying", *(name for name in turning if name != "decaying")],
        "canonical": ["consistent", "decaying", "consistent 6"],
        "body": turning[::-1],
        "net": list(SCHEMES),
    }
    turns = itertools.zip_longest(*by_family.values())
    families = itertools.cycle(by_family)
    made = zip(itertools.chain.from_iterable(turns), families, strict=False)
    return [(scheme, name) for scheme, name in made if scheme is not None]


def cases(rng: Generator, number: int) -> Iterator[tuple[str, Callable[[], Result]]]:
    scheme, name = pairs()[number % len(pairs())]
    programs = Programs(scheme, name)
    label = f"{scheme}, {name}"
    for _ in range(3):
        own = np.random.default_rng(rng.integers(2**63))
        yield label, functools.partial(check, own, programs, name)


class Programs:
    """The two programs of a scheme and a family: forward and reverse, over lanes."""

    def __init__(self, scheme: str, name: str):
        chosen = family(name)

        def end(p):
            args = p["args"]
            start = ej.initial_state(chosen.system, p["q"], p["v"], args)
            made = SCHEMES[scheme](p["alpha"])
            run = ej.simulate(
                chosen.system,
                made,
                start,
                args,
                h=p["h"],
                num_steps=STEPS,
                max_halvings=chosen.halvings,
                throw=False,
            )
            end = run.end.q @ p["on q"] + run.end.v @ p["on v"]
            last = run.multipliers[-1] @ jnp.cos(jnp.arange(run.multipliers.shape[1]))
            value = end + 1e-3 * last + run.audit.dissipated[-1]
            return value, (run.result == ej.RESULTS.successful, run.stats.halvings)

        self.reverse = jax.jit(jax.vmap(jax.value_and_grad(end, has_aux=True)))
        push = lambda p, along: jax.jvp(end, (p,), (along,), has_aux=True)
        self.forward = jax.jit(jax.vmap(push))


def draw(rng: Generator, name: str) -> Any:
    chosen = family(name)
    q, v, args, h = chosen.draw(rng)
    weights = lambda x: jnp.asarray(rng.normal(size=x.shape))
    made = dict(q=q, v=v, args=args, h=h, alpha=rng.uniform(0.1, 0.9))
    made |= {"on q": weights(q), "on v": weights(v)}
    return jax.tree.map(lambda x: jnp.asarray(x, float), made)


def check(rng: Generator, programs: Programs, name: str) -> Result:
    lanes = [draw(rng, name) for _ in range(LANES)]
    flat = jnp.stack([ravel_pytree(p)[0] for p in lanes])
    unravel = jax.vmap(ravel_pytree(lanes[0])[1])
    along = jnp.asarray(rng.normal(size=flat.shape)) * jnp.maximum(jnp.abs(flat), 1e-3)
    (value, (okay, halvings)), gradient = programs.reverse(unravel(flat))
    by_lane = np.asarray(jax.vmap(lambda x: ravel_pytree(x)[0])(gradient))
    reverse = np.sum(by_lane * along, axis=1)
    size = np.sum(np.abs(by_lane * along), axis=1) + np.abs(value) * 1e-3
    _, forward, _ = programs.forward(unravel(flat), unravel(along))

    def at(eps):
        value, _, (okay, parts) = programs.forward(
            unravel(flat + eps * along), unravel(along)
        )
        return np.asarray(value), np.asarray(okay), np.asarray(parts)

    tried = {k: at(k * EPS) for k in (-2, -1, 1, 2)}
    near, far = tried[1][0] - tried[-1][0], tried[2][0] - tried[-2][0]
    difference = (8 * near - far) / (12 * EPS)
    # If a step is divided at one of the points only, the function jumps by a truncation
    # error.
    smooth = np.asarray(okay).copy()
    for _, fine, parts in tried.values():
        smooth &= fine & np.all(parts == np.asarray(halvings), axis=1)
    apart = np.abs(near / (2 * EPS) - far / (4 * EPS))
    found, measures = [], {"failed": float(np.mean(~np.asarray(okay)))}
    measures["halved"] = float(np.mean(np.asarray(halvings).any(axis=1) & smooth))
    for lane in range(LANES):
        if not okay[lane]:
            continue
        wrong = abs(forward[lane] - reverse[lane]) / size[lane]
        off = abs(difference[lane] - reverse[lane]) / size[lane] if smooth[lane] else 0.0
        measures["forward"] = max(measures.get("forward", 0.0), float(wrong))
        measures["differences"] = max(measures.get("differences", 0.0), float(off))
        if not (wrong <= 1e-8 and off <= 1e-6 + 0.1 * apart[lane] / size[lane]):
            numbers = f"{reverse[lane]:.9e}, {forward[lane]:.9e}, {difference[lane]:.9e}"
            parts = f"halvings {np.max(halvings[lane])}, size {size[lane]:.1e}"
            found.append(f"lane {lane}: reverse, forward, differences {numbers}, {parts}")
    found += poisoned(rng, programs, flat, unravel, by_lane, np.asarray(okay))
    return Result(found, measures)


def poisoned(rng, programs, flat, unravel, healthy, okay) -> Iterator[str]:
    """Gives one lane a step that is far too long, or an inertia of zero."""
    lane = int(rng.integers(LANES))
    for what in ("long step", "not a number"):
        p = unravel(flat)
        if what == "long step":
            p["h"] = p["h"].at[lane].set(1e6)
        else:
            p["h"] = p["h"].at[lane].set(jnp.nan)
        (_, (fine, _)), gradient = programs.reverse(p)
        if fine[lane] and what == "not a number":
            yield f"{what}: success"
        by_lane = np.asarray(jax.vmap(lambda x: ravel_pytree(x)[0])(gradient))
        for other in np.flatnonzero(okay):
            if other == lane:
                continue
            size = np.max(np.abs(healthy[other]))
            apart = np.max(np.abs(by_lane[other] - healthy[other])) / size
            if not apart <= 1e-9:
                yield f"{what} in lane {lane} changes lane {other} by {apart:.1e}"
