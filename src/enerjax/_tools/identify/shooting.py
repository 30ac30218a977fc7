"""Residuals of long runs in pieces."""

from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ..._types import Scalar


Window: TypeAlias = Callable[[Any, Any, Any], tuple[PyTree[Array], PyTree[Array]]]


class MultipleShooting(eqx.Module):
    """The residuals of a run that is cut into windows, for `fit`.

    In a chaotic motion a small change of a parameter grows, by a factor each second, until
    the end of the run has nothing to do with the data: the cost of a long run has many
    minima, and a fit ends in one nearby. Within short windows it has not. So each window
    begins where it likes; that it does so where the one before ends is asked for by
    residuals of their own:

        def window(parameters, start, data):
            sol = ej.simulate(system, scheme, state_of(start), parameters, ...)
            return (sol.ys.q - data) / noise, numbers_of(sol.ys.q[-1], sol.ys.v[-1])

        guess = {"parameters": {"g": 9.0}, "starts": numbers_from_data}
        loose = ej.fit(ej.MultipleShooting(window, 1 / noise), guess, windows)
        tight = ej.fit(ej.MultipleShooting(window, 100 / noise), loose.parameters, windows)

    A function of `{"parameters": ..., "starts": ...}` and the data; starts and data are
    stacked along a leading axis, a row for each window. Starts and ends of windows are
    pytrees of independent coordinates and velocities, as many numbers as the motion is
    free to choose (of a double pendulum its two angles and their rates), since each one is
    an unknown. Choose windows in which errors of the guess do not grow much.

    - `window`: a function of the parameters, the start of a window and its data that
      returns its residuals, as for `fit`, and where it ends. All windows have the same
      shapes, and run side by side.
    - `continuity`: what a gap between two windows is multiplied by. Small, the gaps absorb
      what a wrong guess leaves over, and the fit finds its way; large, the windows become
      one run. Begin with the factor of the data, and end with a hundred times that. A new
      value compiles nothing.

    **Reference:** H. G. Bock (1983), Recent advances in parameter identification techniques
    for ODE, in: Numerical Treatment of Inverse Problems in Differential Equations.
    """

    window: Window = eqx.field(static=True)
    continuity: Scalar = eqx.field(converter=jnp.asarray)

    def __call__(self, unknowns: dict[str, Any], data: Any) -> dict[str, Any]:
        starts = unknowns["starts"]
        run = lambda start, piece: self.window(unknowns["parameters"], start, piece)
        inside, ends = jax.vmap(run)(starts, data)
        gap = lambda end, start: self.continuity * (end[:-1] - start[1:])
        return {"data": inside, "gaps": jax.tree.map(gap, ends, starts)}
