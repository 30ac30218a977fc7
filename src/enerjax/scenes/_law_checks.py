"""What a part resolves to, and what its law returns: errors name the part."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._programs import module_of
from .._types import Coordinates
from ._ends import Ends
from ._force import pushes
from ._frames import Numbers
from ._inerters import AbstractInerter
from ._laws import (
    AbstractConstraintLaw,
    AbstractForceLaw,
    AbstractPotentialLaw,
    AbstractSpringLaw,
    Acting,
    Driven,
    Flywheel,
    Gap,
    Penalized,
)
from ._layout import Layout, Links
from ._measures import AbstractLaw
from ._parameters import Parameters
from ._part import AbstractForce
from ._pose_view import evaluate, View
from .contacts import AbstractContact
from .joints import AbstractJoint


_OF_FORCES = AbstractPotentialLaw | AbstractSpringLaw | AbstractForceLaw


def resolved_part(part: Any, ends: Ends) -> tuple[AbstractLaw, Numbers]:
    """The law and the numbers of a part, if they are what its kind needs."""
    told, found = f"`resolve` of '{part.name}' must return", part.resolve(ends)
    if not isinstance(found, tuple) or len(found) != 2:
        raise TypeError(f"{told} a law and its numbers, got {found!r}.")
    law, numbers = found
    kinds, names = Driven, "a `Driven` law"
    if isinstance(part, AbstractJoint):
        kinds, names = AbstractConstraintLaw, "an `AbstractConstraintLaw`"
    elif isinstance(part, AbstractForce):
        kinds = _OF_FORCES
        names = "an `AbstractPotentialLaw`, `AbstractSpringLaw` or `AbstractForceLaw`"
    elif isinstance(part, AbstractContact):
        kinds, names = Gap | Penalized, "a `Gap` or `Penalized` law"
    elif isinstance(part, AbstractInerter):
        kinds, names = Flywheel, "a `Flywheel` law"
    if not isinstance(law, kinds):
        raise TypeError(f"{told} {names} and its numbers, got {law!r}.")
    try:
        hash(law)
    except TypeError as error:
        raise TypeError(
            f"The law of '{part.name}' cannot be compared ({error}): write it as a frozen "
            "dataclass, with arrays among the numbers and not in its fields."
        ) from None
    if not isinstance(numbers, dict):
        raise TypeError(f"{told} its numbers as a dictionary, got {numbers!r}.")
    if isinstance(law, AbstractConstraintLaw) and law.keeps == "axis":
        if not {"frame_a", "frame_b"} <= {*numbers}:
            raise ValueError(
                f"{told} `frame_a` and `frame_b` among its numbers, as of `ends.axes`: its "
                "law says that it keeps an axis."
            )
    return law, {key: _floats(part.name, key, x) for key, x in numbers.items()}


def _floats(part: str, key: str, value: Any) -> Any:
    try:
        array = module_of(value).asarray(value) * 1.0
    except (TypeError, ValueError):
        array = None
    if array is None or not np.issubdtype(array.dtype, np.floating):
        raise TypeError(f"`{key}` of '{part}' must be of numbers, got {value!r}.")
    return array


def check_laws(layout: Layout, q: Coordinates, args: Parameters) -> None:
    """Raises for laws that return something else than what they are asked for."""
    for group, numbers in zip(layout.joint_groups, args.tables["joints"], strict=True):
        rows = _returned(layout, q, group, numbers)
        _check(group, rows, 1, "a vector with an entry for each constraint")
    for group, numbers in zip(layout.force_groups, args.tables["forces"], strict=True):
        value = _returned(layout, q, group, numbers)
        if isinstance(group.law, AbstractForceLaw):
            _check_force(layout, q, group, numbers, value)
        else:
            _check(group, value, 0, "a scalar, the energy")


def _check_force(
    layout: Layout, q: Coordinates, group: Links, numbers: Numbers, value: Any
) -> None:
    assert isinstance(group.law, AbstractForceLaw)
    role = type(group.law.measure).__name__
    if group.law.measure.is_vector:
        _check(group, value, 1, "a vector, as its `is_vector` says", role)
    else:
        _check(group, value, 0, "a scalar", role)
    if isinstance(group.law, Acting):
        return  # its signal is checked where it is asked
    by_rate = lambda q, rate: pushes(group, numbers, View(layout, q), rate)
    force = eqx.filter_eval_shape(by_rate, q, value)
    role, wanted = f"{type(group.law).__name__}.force", value.shape[1:]
    _check(group, force, len(wanted), f"shape {wanted}, that of the rate", role)
    if force.shape != value.shape:
        raise ValueError(
            f"`{role}` of '{group.names[0]}' must return shape {wanted}, that of the rate; "
            f"got shape {force.shape[1:]}."
        )


def _returned(layout: Layout, q: Coordinates, group: Links, numbers: Numbers) -> Any:
    of_q = lambda q: evaluate(group, View(layout, q), numbers)
    return eqx.filter_eval_shape(of_q, q)


def _check(
    group: Links, found: Any, ndim: int, wanted: str, role: str | None = None
) -> None:
    """Raises for what is no array of floats with so many axes for each part."""
    role = type(group.law).__name__ if role is None else role
    told = f"`{role}` of '{group.names[0]}' must return {wanted}"
    if not isinstance(found, jax.ShapeDtypeStruct):
        raise TypeError(f"{told}; got a {type(found).__name__}.")
    if not jnp.issubdtype(found.dtype, jnp.floating):
        raise TypeError(f"{told}, of floats; got {found.dtype}.")
    if len(found.shape) != ndim + 1:
        raise ValueError(f"{told}; got shape {found.shape[1:]}.")
