from .base import (
    AbstractCarryingSolve as AbstractCarryingSolve,
    AbstractScheme as AbstractScheme,
    AbstractSimplifiedSolve as AbstractSimplifiedSolve,
    AbstractSingleSolve as AbstractSingleSolve,
    StepEnd as StepEnd,
    StepProblem as StepProblem,
)
from .composed import Composed as Composed
from .energies import Energies as Energies
from .energy_consistent import EnergyConsistent as EnergyConsistent
from .energy_decaying import EnergyDecaying as EnergyDecaying
from .energy_preserving import EnergyPreserving as EnergyPreserving
from .generalized_alpha import GeneralizedAlpha as GeneralizedAlpha
from .kappa_decaying import KappaDecaying as KappaDecaying
from .rattle import Rattle as Rattle
