"""The time integration schemes, and the base classes and operators for further schemes.

A new scheme is a subclass of `AbstractOneSolveScheme`. `docs/write-your-own-scheme.md`
shows an example, from its equations to its tests.
"""

from .._operators import (
    AbstractModel as AbstractModel,
    Gradient as Gradient,
    Increment as Increment,
    Reaction as Reaction,
)
from .._results import RESULTS as RESULTS
from .base import (
    AbstractOneSolveScheme as AbstractOneSolveScheme,
    AbstractScheme as AbstractScheme,
    AbstractSchemeWithChord as AbstractSchemeWithChord,
    AbstractSchemeWithMemory as AbstractSchemeWithMemory,
    AbstractSchemeWithRotations as AbstractSchemeWithRotations,
    Energies as Energies,
    ForceLaw as ForceLaw,
    Formulation as Formulation,
    StepEnd as StepEnd,
    StepProblem as StepProblem,
)
from .composed import Composed as Composed
from .energy_consistent import EnergyConsistent as EnergyConsistent
from .energy_decaying import EnergyDecaying as EnergyDecaying
from .energy_momentum_decaying import EnergyMomentumDecaying as EnergyMomentumDecaying
from .energy_preserving import EnergyPreserving as EnergyPreserving
from .generalized_alpha import GeneralizedAlpha as GeneralizedAlpha
from .kappa_decaying import KappaDecaying as KappaDecaying
from .rattle import Rattle as Rattle
