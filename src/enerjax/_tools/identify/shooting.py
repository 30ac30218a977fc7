"""Multiple shooting: the residuals of a long run that is divided into windows."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree
from typing_extensions import TypeAliasType

from ..._types import Scalar


Window = TypeAliasType(
    "Window", Callable[[Any, Any, Any], tuple[PyTree[Array], PyTree[Array]]]
)


class MultipleShooting(eqx.Module):
    """The residuals of a run that is divided into windows, for `fit`.

    In a chaotic motion the effect of a small change of a parameter grows exponentially, so
    the cost of a long run has many local minima, and that of a short window has few. The
    start of each window is an unknown of the fit, and additional residuals require that
    each window starts where the one before ends:

        def window(parameters, start, data):
            sol = ej.simulate(system, scheme, state_of(start), parameters, ...)
            return (sol.ys.q - data) / noise, numbers_of(sol.ys.q[-1], sol.ys.v[-1])

        guess = {"parameters": {"g": 9.0}, "starts": numbers_from_data}
        loose = ej.fit(ej.MultipleShooting(window, 1 / noise), guess, windows)
        tight = ej.fit(ej.MultipleShooting(window, 100 / noise), loose.parameters, windows)

    The residuals are a function of `{"parameters": ..., "starts": ...}` and the data;
    starts and data are stacked along a leading axis, with a row for each window. Starts and
    ends of windows are pytrees of independent coordinates and velocities (for a double
    pendulum, its two angles and their rates). Choose windows in which errors of the guess
    do not grow much.

    - `window`: a function of the parameters, the start of a window and its data that
      returns its residuals, as for `fit`, and its end. All windows have the same shapes,
      and are run in one batch.
    - `continuity`: the factor of the gaps between windows. If it is small, gaps absorb the
      errors of the guess, and the fit converges from further away; if it is large, the
      windows form one run. First use the factor of the data, then a hundred times that. A
      new value does not recompile.

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
