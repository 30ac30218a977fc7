from . import elementary as elementary
from .base import AbstractDerivative as AbstractDerivative
from .chain_rule import (
    ChainRule as ChainRule,
    discrete_fallbacks as discrete_fallbacks,
    discrete_grad as discrete_grad,
    discrete_jacobian as discrete_jacobian,
    discrete_jvp as discrete_jvp,
)
from .corrected import (
    AbstractCorrected as AbstractCorrected,
    Gonzalez as Gonzalez,
    MeanValue as MeanValue,
)
from .rotations import ANGLE as ANGLE, OTHER as OTHER, RotationRule as RotationRule
