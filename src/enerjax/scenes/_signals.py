"""The numbers of drives and forces that functions of the time define."""

import jax.numpy as jnp
from jaxtyping import Array

from .._types import Scalar
from ._laws import Acting, Driven
from ._layout import Links
from ._motion_view import Moving
from ._parameters import Parameters
from ._user_functions import ask


def at_time(
    group: Links,
    numbers: dict[str, Array],
    t: Scalar,
    args: Parameters,
    view: Moving | None = None,
) -> dict[str, Array]:
    """The numbers of a group, with the value of its signal if it has one.

    All links of a group have the same signal. Those of forces may depend on the `view`.
    """
    if not isinstance(group.law, Acting | Driven):
        return numbers
    feedback = isinstance(group.law, Acting) and group.law.feedback
    inputs = (view, t, args) if feedback else (t, args)
    value = jnp.asarray(ask(group.names[0], group.law.signal, *inputs)).astype(t.dtype)
    wanted = (args.layout.dimension,) if group.law.measure.is_vector else ()
    if value.shape != wanted:
        raise ValueError(
            f"The function of '{group.names[0]}' must return "
            f"{f'shape {wanted}' if wanted else 'a scalar'}, got shape {value.shape}."
        )
    return numbers | dict(value=jnp.broadcast_to(value, (len(group.names), *wanted)))
