from .base import (
    AbstractScheme as AbstractScheme,
    AbstractSingleSolve as AbstractSingleSolve,
    StepEnd as StepEnd,
    StepProblem as StepProblem,
)
from .composed import Composed as Composed
from .energy_consistent import EnergyConsistent as EnergyConsistent
from .energy_decaying import EnergyDecaying as EnergyDecaying
from .energy_preserving import EnergyPreserving as EnergyPreserving
from .kappa_decaying import KappaDecaying as KappaDecaying
