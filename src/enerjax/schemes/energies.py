"""Where the energy of a step went."""

import equinox as eqx
from jaxtyping import Array, Float


class Energies(eqx.Module):
    """The account of a step, or since the row before.

    - `dissipated`: removed by the scheme, by its own identity.
    - `work`: of the forces, dampers included.
    - `damped`: taken by dampers: `-work` of the part of the forces that changes sign with
      the velocity.
    - `drive_work`: of the driven constraints.

    `None` where the system has no forces, or no driven constraints.
    """

    dissipated: Float[Array, "..."]
    work: Float[Array, "..."] | None
    damped: Float[Array, "..."] | None
    drive_work: Float[Array, "..."] | None
