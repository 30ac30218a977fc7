"""Bodies, joints, forces and drives that compile to the functions of a `System`."""

from . import bodies as bodies, drives as drives, forces as forces, joints as joints
from ._motions import Gap as Gap
from ._parameters import Parameters as Parameters
from .scene import Reaction as Reaction, Scene as Scene
