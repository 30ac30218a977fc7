"""The findings of one random case, and the random systems that cases share."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.random import Generator

import enerjax as ej


@dataclasses.dataclass(frozen=True)
class Result:
    """Findings in words, and measurements, of which larger ones are worse."""

    findings: list[str]
    measures: dict[str, float]


@functools.cache
def structure(n: int) -> dict[str, np.ndarray]:
    """The structure of a system of `n` coordinates; its numbers are arguments."""
    points = n // 2
    order = np.random.default_rng(n).permutation(points)
    rods = order[: 2 * (points // 4)].reshape(-1, 2)
    ring = np.stack([np.arange(points), np.roll(np.arange(points), -1)], axis=1)
    return dict(rods=rods, ring=ring)


def kinetic(v, args):
    return 0.5 * v @ (args["M"] @ v)


def potential(q, args):
    """Quadratic and quartic terms, waves, wells, and forces between points of a ring."""
    x = q - args["at"]
    pairs = structure(q.shape[0])["ring"]
    points = q.reshape(-1, 2)
    between = points[pairs[:, 0]] - points[pairs[:, 1]]
    near = args["size"] / jnp.sum(between**2, axis=1)
    smooth = 0.5 * x @ (args["K"] @ x) + 0.25 * args["quartic"] @ x**4
    waves = args["wave"] @ jnp.cos(args["number"] * x + args["phase"])
    wells = -args["well"] @ (1 / (1 + (x - args["centre"]) ** 2))
    return smooth + waves + wells + args["bond"] @ (near**6 - near**3)


def constraint(q, args):
    """Rods, a plane, and an ellipsoid, which are all satisfied at `at`."""
    rods = structure(q.shape[0])["rods"]

    def squares(q):
        points = q.reshape(-1, 2)
        return jnp.sum((points[rods[:, 0]] - points[rods[:, 1]]) ** 2, axis=1)

    x = q - args["at"]
    plane = args["plane"] @ x
    quadric = args["axes"] @ ((x + args["shift"]) ** 2 - args["shift"] ** 2)
    return jnp.append(squares(q) - squares(args["at"]), jnp.stack([plane, quadric]))


CONSTRAINED = ej.System(kinetic, potential, constraint)
FREE = ej.System(kinetic, potential)


def random_args(rng: Generator, n: int, convex: bool) -> dict[str, Any]:
    """The numbers of a system; those of concave terms are zero if it must be convex."""
    points = n // 2
    width = int(np.ceil(np.sqrt(points)))
    rows, columns = np.divmod(np.arange(points), width)
    # To and fro along the rows, so that points of the ring are neighbours but for the last.
    columns = np.where(rows % 2 == 0, columns, width - 1 - columns)
    at = 1.2 * np.stack([columns, rows], axis=1) + rng.uniform(-0.1, 0.1, (points, 2))
    spread = rng.normal(size=(n, n)) / np.sqrt(n)
    mass = np.exp(rng.uniform(-1, 1, n))
    inertia = np.diag(mass) + 0.3 * spread @ spread.T
    pull = rng.normal(size=(n, n)) / np.sqrt(n)
    bent = 0.0 if convex else 1.0
    stiffness = pull @ pull.T + bent * 0.4 * (spread + spread.T)
    some = lambda low, high: rng.uniform(low, high, n)
    made = dict(
        M=inertia,
        K=stiffness * np.exp(rng.uniform(-1, 3)),
        at=at.reshape(-1),
        quartic=some(0, 3) * rng.integers(2),
        wave=bent * some(-1, 1),
        number=some(0.5, 4),
        phase=some(0, 6),
        well=bent * some(-1, 2),
        centre=some(-1, 1),
        size=rng.uniform(0.8, 1.2, points),
        bond=bent * rng.uniform(0, 0.5, points),
        plane=rng.normal(size=n),
        axes=some(0.5, 1.5),
        shift=rng.normal(size=n),
    )
    return jax.tree.map(lambda x: jnp.asarray(x, float), made)


def random_start(rng: Generator, n: int, args: dict[str, Any]):
    """A point near the constraints, but not on them."""
    q = args["at"] + 0.05 * rng.normal(size=n)
    return q, jnp.asarray(rng.normal(size=n) * np.exp(rng.uniform(-2, 1)))
