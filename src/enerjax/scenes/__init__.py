"""Bodies, joints, forces and drives that compile to the functions of a `System`."""

from . import (
    bodies as bodies,
    contacts as contacts,
    drives as drives,
    forces as forces,
    joints as joints,
    shapes as shapes,
)
from ._body_coordinates import quaternion_rates as quaternion_rates, rotation as rotation
from ._closure_errors import Gap as Gap
from ._ends import Ends as Ends
from ._frames import Frame as Frame
from ._importing import from_mjcf as from_mjcf, from_urdf as from_urdf
from ._laws import (
    AbstractConstraintLaw as AbstractConstraintLaw,
    AbstractForceLaw as AbstractForceLaw,
    AbstractNonholonomicLaw as AbstractNonholonomicLaw,
    AbstractPotentialLaw as AbstractPotentialLaw,
    AbstractSpringLaw as AbstractSpringLaw,
)
from ._measures import (
    AbstractMeasure as AbstractMeasure,
    AbstractTurn as AbstractTurn,
    Place as Place,
    PlanarTurn as PlanarTurn,
    Separation as Separation,
    Slide as Slide,
    Turn as Turn,
)
from ._motion import (
    BodyMotion as BodyMotion,
    LinkMotion as LinkMotion,
    Motion as Motion,
)
from ._parameters import Parameters as Parameters
from ._reactions import Reaction as Reaction
from ._readouts import Readout as Readout
from ._section_forces import SectionForces as SectionForces
from .scene import Scene as Scene
from .section import Section as Section
