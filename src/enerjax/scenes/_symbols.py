"""What joints, forces and drives look like, from their laws."""

from typing import Literal, TypeAlias

from ._laws import (
    AbstractConstraintLaw,
    AbstractForceLaw,
    AbstractSpringLaw,
    Alignment,
    Driven,
    Gap,
    Length,
    Penalized,
    Steady,
    Viscous,
)
from ._measures import AbstractLaw


# - "pin": holds two points together: a hinge with an axis, two axes or, as a ball, none.
# - "slider": lets a point slide along its axis; "plane": along the plane to which its axis
#   is normal; "weld": holds bodies together; "rod": keeps a distance; "contact": any other
#   constraint, and gaps.
# - "spring", "damper", "actuator": between two points.
# - "torsion spring", "torsion damper", "motor": about a hinge.
# - "load": acts on a point, or moves it; "field": any other force.
Symbol: TypeAlias = Literal[
    "pin", "slider", "plane", "weld", "rod", "contact", "spring", "damper", "actuator",
    "torsion spring", "torsion damper", "motor", "load", "field",
]  # fmt: skip


def symbol_of(law: AbstractLaw) -> Symbol:
    if isinstance(law, AbstractConstraintLaw):
        return _symbol_of_joint(law)
    if isinstance(law, Gap | Penalized):
        return "contact"
    measure = getattr(law, "measure", None)
    if measure is None:
        return "field"
    if measure.is_vector:
        return "load"
    if isinstance(law, Steady):
        return "motor" if measure.is_angle else "actuator"
    if isinstance(law, AbstractSpringLaw):
        return "torsion spring" if measure.is_angle else "spring"
    if isinstance(law, Viscous):
        return "torsion damper" if measure.is_angle else "damper"
    if isinstance(law, AbstractForceLaw | Driven):
        return "motor" if measure.is_angle else "actuator"
    return "field"


def _symbol_of_joint(law: AbstractConstraintLaw) -> Symbol:
    if isinstance(law, Length):
        return "rod"
    if not isinstance(law, Alignment):
        return "contact"
    if law.along is None:
        planar_weld = law.square == ((0, 1),)
        return "weld" if planar_weld or law.keeps == "directions" else "pin"
    return "plane" if law.along == (2,) else "slider"
