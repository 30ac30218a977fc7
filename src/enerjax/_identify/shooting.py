"""Residuals of long runs in pieces."""

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
from jaxtyping import Array, PyTree


Window: TypeAlias = Callable[[Any, Any, Any], tuple[PyTree[Array], PyTree[Array]]]


def multiple_shooting(
    window: Window, continuity: float = 1e3
) -> Callable[[Any, Any], PyTree[Array]]:
    """The residuals of a run that is cut into windows, for `fit`.

    In a chaotic motion a small change of a parameter grows, by a factor each second, until
    the end of the run has nothing to do with the data: the cost of a long run has many
    minima, and a fit ends in one nearby. Within short windows it has not. So each window
    begins where it likes; that it does so where the one before ends is asked for by
    residuals of their own, which vanish in the end:

        def window(parameters, start, data):
            state = ej.initial_state(system, *positions(start), parameters)
            sol = ej.simulate(..., throw=False)
            return (sol.ys.q - data) / noise, angles(sol.ys.q[-1], sol.ys.v[-1])

        residuals = ej.multiple_shooting(window)
        guess = {"parameters": {"g": 9.0}, "starts": angles_from_data}
        ej.fit(residuals, guess, data_in_windows)

    **Arguments:**

    - `window`: a function of the parameters, the start of a window and its data that
      returns its residuals, as for `fit`, and where it ends. Starts and ends are pytrees of
      independent coordinates and velocities: as many numbers as the motion is free to
      choose (of a double pendulum its two angles and their rates), since each one is an
      unknown. All windows have the same shapes, and run side by side.
    - `continuity`: what a gap between two windows is multiplied by. Gaps in units of the
      coordinates become about `1/continuity` of the noise of the data.

    **Returns:** a function for `fit` of `{"parameters": ..., "starts": ...}` and the data.
    The starts and the data are stacked along a leading axis, a row for each window.

    **Reference:** H. G. Bock (1983), Recent advances in parameter identification techniques
    for ODE, in: Numerical Treatment of Inverse Problems in Differential Equations.
    """

    def residuals(unknowns: dict[str, Any], data: Any) -> dict[str, Any]:
        starts = unknowns["starts"]
        run = lambda start, piece: window(unknowns["parameters"], start, piece)
        inside, ends = jax.vmap(run)(starts, data)
        gap = lambda end, start: continuity * (end[:-1] - start[1:])
        return {"data": inside, "gaps": jax.tree.map(gap, ends, starts)}

    return residuals
