"""Forces that depend on the rates of measures, such as those of dampers, and say so."""

import abc
from typing import TypeAlias

import equinox as eqx
from jaxtyping import Array

from .._types import Args, Coordinates, Scalar, Velocities


# The measures of each kind of dampers, or their resistances.
MeasureArrays: TypeAlias = tuple[Array, ...]


class AbstractDampedForce(eqx.Module):
    """A force that contains those of dampers, `-dGamma/dq^T c dGamma/dt`.

    Measures `Gamma` are functions of the coordinates, such as the length of a damper. The
    resistances `c` may depend on the motion. The chord method takes them from here; the
    motion does not depend on them.
    """

    @abc.abstractmethod
    def __call__(
        self, q: Coordinates, v: Velocities, t: Scalar, args: Args = None
    ) -> Velocities:
        """The whole force."""

    @abc.abstractmethod
    def measures(self, q: Coordinates, args: Args = None) -> MeasureArrays:
        """The measures, arrays of shape `(dampers,)` or `(dampers, m)`."""

    @abc.abstractmethod
    def resistances(
        self,
        q: Coordinates,
        v: Velocities,
        t: Scalar,
        args: Args = None,
        *,
        delay: Scalar,
    ) -> MeasureArrays:
        """`c`, in arrays of the shape of the measures (force per rate of a measure).

        Of a vector these are the sums of the slopes by all its components. That of a force
        with a gain `k` on the measure itself includes `delay * k`: over a
        short time the measure changes by `delay` times its rate.
        """
