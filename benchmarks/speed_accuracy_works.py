"""The problems of `speed_accuracy.py`, with their reference results."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
from references import HEAVY_TOP, solve
from scipy.integrate import solve_ivp
from scipy.linalg import solveh_banded

import enerjax as ej


G = 9.81
# Runs with larger errors are wrong, and their times are not reported.
BOUND = 0.1
Steps = dict[str, tuple[float, ...]]


@dataclasses.dataclass(frozen=True, eq=False)
class Work:
    """A chain of points with these masses on rods of equal length, or the heavy top.

    `steps`: the numbers of steps for each scheme.
    """

    masses: tuple[float, ...]
    length: float
    end: float
    steps: Steps

    @property
    def is_top(self) -> bool:
        return not self.masses

    @property
    def size(self) -> int:
        return len(self.masses)

    def problem(self) -> ej.problems.Problem:
        if self.is_top:
            return ej.problems.heavy_top_directors()
        system, start, args = ej.problems.chain(self.size, length=self.size * self.length)
        return ej.problems.Problem(system, start, args | dict(m=jnp.array(self.masses)))

    @functools.cache  # noqa: B019
    def exact(self) -> np.ndarray:
        """Positions at the end."""
        if self.is_top:
            args = ej.problems.heavy_top().args
            return solve(HEAVY_TOP, args, np.array([self.end])).q[-1][:3]
        y = np.zeros((2, self.size, 2))
        y[0, :, 0] = self.length * np.arange(1, self.size + 1)
        run = solve_ivp(
            lambda t, y: chain_rates(y, np.array(self.masses)),
            (0, self.end),
            y.ravel(),
            method="DOP853",
            rtol=3e-14,
            atol=1e-14,
        )
        return run.y[: 2 * self.size, -1]

    def positions(self, q: np.ndarray) -> np.ndarray:
        """Of the points, from the coordinates of `problem`."""
        # The mass centre of the top is at the tip of its second director.
        return q[3:6] if self.is_top else q

    def error(self, positions: np.ndarray, exact: np.ndarray) -> float:
        return float(np.max(np.abs(positions - exact)))


def chain_rates(y: np.ndarray, masses: np.ndarray) -> np.ndarray:
    """Points that are held by the tensions of rods; gravity acts along +y."""
    size = masses.size
    q, v = y.reshape(2, size, 2)
    links = np.diff(q, axis=0, prepend=np.zeros((1, 2)))
    spins = np.diff(v, axis=0, prepend=np.zeros((1, 2)))
    # d/dt^2 |link|^2 = 0, with gravity on all points but the support.
    right = np.sum(spins**2, axis=1)
    right[0] += G * links[0, 1]
    inverse = 1 / masses
    both = inverse + np.append(0.0, inverse[:-1])
    diagonal = both * np.sum(links**2, axis=1)
    side = np.append(0.0, -inverse[:-1] * np.sum(links[1:] * links[:-1], axis=1))
    bands = np.stack([side, diagonal])
    tension = right / diagonal if size == 1 else solveh_banded(bands, right)
    pull = -tension[:, None] * links
    pull[:-1] -= pull[1:]
    return np.concatenate([v.ravel(), (inverse[:, None] * pull + [0.0, G]).ravel()])


def _steps(
    second: tuple[float, ...], fourth: tuple[float, ...], high: tuple[float, ...]
) -> Steps:
    """Steps for schemes of orders 2 and 3, for those of order 4, and of higher order."""
    kinds = {
        second: ("EnergyPreserving", "EnergyDecaying(0.5)"),
        fourth: (
            "EnergyConsistent(0)",
            "Composed(EnergyPreserving, 4)",
            "Composed(EnergyConsistent, 6)",
            "Composed(Rattle, 4)",
        ),
        high: ("Composed(Rattle, 6)", "Composed(Rattle, 8)"),
    }
    return {scheme: steps for steps, schemes in kinds.items() for scheme in schemes}


WORKS = {
    "pendulum": Work(
        (1.0,), 1.0, 10.0, _steps((1e-2, 1e-3), (4e-2, 2e-2, 1e-2, 2.5e-3), (5e-2, 2.5e-2))
    ),
    "double pendulum": Work(
        (1.0,) * 2,
        1.0,
        10.0,
        _steps((4e-3, 1e-3), (4e-2, 2e-2, 8e-3, 5e-3, 2e-3), (5e-2, 2.5e-2, 1e-2)),
    ),
    "light inner mass": Work(
        (0.005, 1.0),
        1.0,
        2.0,
        _steps((1e-3, 2.5e-4), (8e-3, 4e-3, 2e-3, 1e-3, 2.5e-4), (1e-2, 5e-3, 2.5e-3)),
    ),
    "heavy top": Work(
        (), 0.0, 1.0, _steps((1e-3, 2.5e-4), (4e-3, 2e-3, 1e-3, 5e-4), (5e-3, 2.5e-3))
    ),
    "chain of 8": Work(
        (1 / 8,) * 8,
        1 / 8,
        2.0,
        _steps((1e-3, 2.5e-4), (4e-3, 2e-3, 1e-3, 2.5e-4), (5e-3, 2.5e-3)),
    ),
    "chain of 64": Work(
        (1 / 64,) * 64,
        1 / 64,
        1.0,
        _steps((1e-3,), (2e-3, 1.25e-3, 1e-3, 5e-4), (2.5e-3, 1.25e-3)),
    ),
}
