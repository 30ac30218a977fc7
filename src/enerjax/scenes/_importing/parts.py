"""The parts of an imported scene, whose laws and numbers follow from the file."""

from typing import Any

import equinox as eqx

from .._ends import Ends
from .._frames import Numbers
from .._inerters import AbstractInerter
from .._laws import AbstractConstraintLaw
from .._measures import AbstractLaw
from .._part import AbstractForce, AbstractPart
from ..joints import AbstractJoint


class AbstractGiven(AbstractPart):
    """A part whose law and numbers do not depend on the start pose."""

    law: eqx.AbstractVar[AbstractLaw]
    numbers: eqx.AbstractVar[Numbers]

    def resolve(self, ends: Ends) -> tuple[Any, Numbers]:
        del ends
        return self.law, self.numbers


class Hinge(AbstractGiven, AbstractJoint):
    """A hinge whose angle is the coordinate of its joint."""

    law: AbstractConstraintLaw
    numbers: Numbers


class Slide(AbstractGiven, AbstractJoint):
    """A slide whose displacement is the coordinate of its joint."""

    law: AbstractConstraintLaw
    numbers: Numbers


class Chain(AbstractGiven, AbstractJoint):
    """Several joints of one body."""

    law: AbstractConstraintLaw
    numbers: Numbers


class Coordinate(AbstractGiven, AbstractJoint):
    """The coordinate of one joint of a chain, which has no constraints of its own."""

    law: AbstractConstraintLaw
    numbers: Numbers


class Weld(AbstractGiven, AbstractJoint):
    """Keeps two bodies in a relative pose that the file gives."""

    law: AbstractConstraintLaw
    numbers: Numbers


class JointSpring(AbstractGiven, AbstractForce):
    """The spring of a joint."""

    law: AbstractLaw
    numbers: Numbers


class JointDamper(AbstractGiven, AbstractForce):
    """The damper of a joint."""

    law: AbstractLaw
    numbers: Numbers


class Armature(AbstractGiven, AbstractInerter):
    """The armature of a joint."""

    law: AbstractLaw
    numbers: Numbers
