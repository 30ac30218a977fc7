from .base import (
    AbstractKinematics as AbstractKinematics,
    ByRates as ByRates,
    Frames as Frames,
    mean_momentum as mean_momentum,
    Rates as Rates,
)
from .configuration import ConfigurationKinematics as ConfigurationKinematics
from .directors import DirectorKinematics as DirectorKinematics
from .plain import IdentityKinematics as IdentityKinematics
from .plane import PlanarKinematics as PlanarKinematics
from .rigid_bodies import body_table as body_table, RigidBodies as RigidBodies
from .rotations import RigidKinematics as RigidKinematics
