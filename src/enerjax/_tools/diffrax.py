"""A model as an ordinary differential equation, for the solvers of diffrax."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._operators import AbstractModel, make_model
from .._programs import compiled
from .._system import AbstractSystem, check_system, State
from .._types import Args, Coordinates, Multipliers, Real, Velocities


class IndexReduced(eqx.Module):
    """The vector field `y' = f(t, y)` of a system, its constraints differentiated twice.

    `y = (q, v)`; of `System.from_lagrangian` and `System.from_hamiltonian` `(q, p)`.
    """

    model: AbstractModel

    def __call__(
        self, t: Real, y: tuple[Coordinates, Velocities], args: Any = None
    ) -> tuple[Coordinates, Velocities]:
        acceleration, _ = self.model.accelerations(self._inner(t, y))
        return self.model.lift(*y), acceleration

    def state(self, t: Real, y: tuple[Coordinates, Velocities]) -> State:
        """The `State` that corresponds to `y`."""
        return self.model.to_user(self._inner(t, y))

    def multipliers(self, t: Real, y: tuple[Coordinates, Velocities]) -> Multipliers:
        """The multipliers `lambda` in this state, shape `(nc,)`."""
        return self.model.multipliers(self._inner(t, y))

    def _inner(self, t: Real, y: tuple[Coordinates, Velocities]) -> State:
        q, v = y
        timed = self.model.system.is_timed
        return State(q, v, jnp.asarray(t, q.dtype) if timed else None)


def to_diffrax(
    system: AbstractSystem, start: State, args: Args = None, *, t0: Real = 0.0
) -> tuple[Any, tuple[Coordinates, Velocities]]:
    """The same model as an ordinary differential equation for the solvers of diffrax.

        term, y0 = ej.to_diffrax(system, start, args)
        diffrax.diffeqsolve(term, diffrax.Dopri8(), 0.0, 10.0, 1e-3, y0, ...)

    The accelerations follow from the equations of motion with the constraints
    differentiated twice (index reduction), so the constraints drift: positions like `t^2`,
    velocities like `t`, by the error of the solver. All numbers in `args` and the start are
    leaves of the term and of `y0`; for derivatives, call `to_diffrax` inside the
    differentiated function. The `args` of `diffeqsolve` are not used.

    **Arguments:**

    - `system`, `start`, `args`: as for `simulate`.
    - `t0`: the time of the start, for `force` and `driven`.

    **Returns:** a `diffrax.ODETerm` and the state `y0 = (q, v)`; for
    `System.from_lagrangian` and `from_hamiltonian` it is `(q, p)`.
    `term.vector_field.state(t, y)` is the `State`, and
    `term.vector_field.multipliers(t, y)` are the multipliers, shape `(nc,)`.

    **Raises:** `ImportError` if diffrax is not installed (the extra `diffrax`);
    `ValueError` or `TypeError` for bad input, as `simulate`.

    **Reference:** C. W. Gear, B. Leimkuhler and G. K. Gupta, J. Comput. Appl. Math. 12-13
    (1985) 77-90, on index reduction and the drift that it brings.
    """
    try:
        import diffrax  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "`to_diffrax` needs diffrax, which is part of the extra `diffrax`: "
            'python -m pip install "enerjax[diffrax]"'
        ) from error
    start, args, _ = check_system(system, start, args, t0)
    model = _model(system, start, args)
    begin = model.to_internal(start)
    return diffrax.ODETerm(IndexReduced(model)), (begin.q, begin.v)


@compiled
def _model(system: AbstractSystem, start: State, args: Args) -> AbstractModel:
    """The model, made in a program, where the numbers of the start are not known.

    Otherwise what is zero at the start would count as zero everywhere: the pattern of the
    constraints of a chain that starts horizontally would lack all vertical coordinates.
    """
    return make_model(system, start, args)
