"""Chains of points on rods for solvers that call Python.

The functions are compiled with numba (of the extra `peers`), so that the time is that of
the solver. Gravity acts along +y."""

# pyright: reportMissingImports=false

import numba
import numpy as np


G = 9.81


@numba.njit
def rates(y: np.ndarray, masses: np.ndarray) -> np.ndarray:
    """Of positions and velocities; the tensions by elimination from rod to rod."""
    size = masses.size
    q, v = y[: 2 * size].reshape(size, 2), y[2 * size :].reshape(size, 2)
    links, spins = q.copy(), v.copy()
    links[1:] -= q[:-1]
    spins[1:] -= v[:-1]
    pivot, tension = np.empty(size), np.empty(size)
    for k in range(size):
        length2 = links[k, 0] ** 2 + links[k, 1] ** 2
        pivot[k] = length2 / masses[k]
        tension[k] = spins[k, 0] ** 2 + spins[k, 1] ** 2
        if k == 0:
            tension[k] += G * links[k, 1]
            continue
        pivot[k] += length2 / masses[k - 1]
        side = _side(links, masses, k)
        pivot[k] -= side**2 / pivot[k - 1]
        tension[k] -= side * tension[k - 1] / pivot[k - 1]
    tension[-1] /= pivot[-1]
    for k in range(size - 2, -1, -1):
        tension[k] = (tension[k] - _side(links, masses, k + 1) * tension[k + 1]) / pivot[k]
    out = np.empty_like(y)
    out[: 2 * size] = y[2 * size :]
    for k in range(size):
        for j in range(2):
            pull = -tension[k] * links[k, j]
            if k + 1 < size:
                pull += tension[k + 1] * links[k + 1, j]
            out[2 * (size + k) + j] = pull / masses[k] + G * j
    return out


@numba.njit
def _side(links: np.ndarray, masses: np.ndarray, k: int) -> float:
    """The entry of the tensions of rods `k - 1` and `k`."""
    dot = links[k, 0] * links[k - 1, 0] + links[k, 1] * links[k - 1, 1]
    return -dot / masses[k - 1]


@numba.njit
def residual(
    y: np.ndarray, rate: np.ndarray, masses: np.ndarray, length: float, out: np.ndarray
) -> None:
    """Stabilised as by Gear, Gupta and Leimkuhler.

    For each point: position, velocity, tension of its rod, stabilising multiplier.
    """
    size = masses.size
    y, rate = y.reshape(size, 6), rate.reshape(size, 6)
    rows = out.reshape(size, 6)
    links, spins = y[:, :2].copy(), y[:, 2:4].copy()
    links[1:] -= y[:-1, :2]
    spins[1:] -= y[:-1, 2:4]
    for k in range(size):
        for j in range(2):
            drift, pull = y[k, 5] * links[k, j], y[k, 4] * links[k, j]
            if k + 1 < size:
                drift -= y[k + 1, 5] * links[k + 1, j]
                pull -= y[k + 1, 4] * links[k + 1, j]
            rows[k, j] = rate[k, j] - y[k, 2 + j] + drift
            rows[k, 2 + j] = masses[k] * (rate[k, 2 + j] - G * j) + pull
        rows[k, 4] = links[k, 0] ** 2 + links[k, 1] ** 2 - length**2
        rows[k, 5] = links[k, 0] * spins[k, 0] + links[k, 1] * spins[k, 1]
