from importlib.metadata import version as _version

from . import problems as problems
from ._analysis import (
    Equilibrium as Equilibrium,
    equilibrium as equilibrium,
    Mobility as Mobility,
    mobility as mobility,
    Modes as Modes,
    modes as modes,
)
from ._audit import Audit as Audit
from ._diffrax import IndexReduced as IndexReduced, to_diffrax as to_diffrax
from ._discrete import (
    AbstractDerivative as AbstractDerivative,
    ChainRule as ChainRule,
    discrete_fallbacks as discrete_fallbacks,
    discrete_grad as discrete_grad,
    discrete_jacobian as discrete_jacobian,
    discrete_jvp as discrete_jvp,
    Gonzalez as Gonzalez,
    MeanValue as MeanValue,
)
from ._energies import Energies as Energies
from ._fast_loops import enable_fast_loops as enable_fast_loops
from ._identify import (
    Fit as Fit,
    fit as fit,
    MultipleShooting as MultipleShooting,
)
from ._initial import (
    consistent_start as consistent_start,
    ConsistentStart as ConsistentStart,
    initial_state as initial_state,
)
from ._linear import KLU as KLU
from ._measure import (
    order_table as order_table,
    OrderTable as OrderTable,
    work_precision as work_precision,
    WorkPrecision as WorkPrecision,
)
from ._newton import Newton as Newton
from ._results import RESULTS as RESULTS
from ._run import simulate as simulate, StepController as StepController
from ._schemes import (
    AbstractScheme as AbstractScheme,
    Composed as Composed,
    EnergyConsistent as EnergyConsistent,
    EnergyDecaying as EnergyDecaying,
    EnergyPreserving as EnergyPreserving,
    GeneralizedAlpha as GeneralizedAlpha,
    KappaDecaying as KappaDecaying,
    Rattle as Rattle,
)
from ._solution import Solution as Solution, Statistics as Statistics
from ._step import step as step, StepOutput as StepOutput, Warm as Warm
from ._sweep import Sweep as Sweep, sweep as sweep
from ._system import (
    AbstractSystem as AbstractSystem,
    Elements as Elements,
    State as State,
    System as System,
)
from .scenes import (
    bodies as bodies,
    drives as drives,
    forces as forces,
    Gap as Gap,
    joints as joints,
    Parameters as Parameters,
    Reaction as Reaction,
    Readout as Readout,
    Scene as Scene,
)


__version__ = _version("enerjax")
