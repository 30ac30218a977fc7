from importlib.metadata import version as _version

from . import problems as problems
from ._analysis import (
    consistent_start as consistent_start,
    ConsistentStart as ConsistentStart,
    eigenvalues as eigenvalues,
    Equilibrium as Equilibrium,
    equilibrium as equilibrium,
    initial_state as initial_state,
    Mobility as Mobility,
    mobility as mobility,
    Modes as Modes,
    modes as modes,
)
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
from ._results import RESULTS as RESULTS
from ._run import (
    AbstractController as AbstractController,
    Audit as Audit,
    EqualSteps as EqualSteps,
    Event as Event,
    Events as Events,
    Impact as Impact,
    load as load,
    save as save,
    SaveAt as SaveAt,
    simulate as simulate,
    Solution as Solution,
    Statistics as Statistics,
    step as step,
    StepController as StepController,
    StepOutput as StepOutput,
    Warm as Warm,
)
from ._solvers import (
    AbstractSparseSolver as AbstractSparseSolver,
    KLU as KLU,
    Newton as Newton,
    SparsePattern as SparsePattern,
)
from ._system import (
    AbstractSystem as AbstractSystem,
    Elements as Elements,
    Names as Names,
    State as State,
    System as System,
)
from ._tools.animate import animate as animate
from ._tools.diffrax import IndexReduced as IndexReduced, to_diffrax as to_diffrax
from ._tools.explain import explain as explain, Explanation as Explanation
from ._tools.identify import Fit as Fit, fit as fit, MultipleShooting as MultipleShooting
from ._tools.measure import (
    order_table as order_table,
    OrderTable as OrderTable,
    work_precision as work_precision,
    WorkPrecision as WorkPrecision,
)
from ._tools.sweep import Sweep as Sweep, sweep as sweep
from .scenes import (
    bodies as bodies,
    contacts as contacts,
    drives as drives,
    forces as forces,
    Gap as Gap,
    joints as joints,
    Parameters as Parameters,
    Reaction as Reaction,
    Readout as Readout,
    Scene as Scene,
    Section as Section,
    SectionForces as SectionForces,
    shapes as shapes,
)
from .schemes import (
    AbstractScheme as AbstractScheme,
    Composed as Composed,
    Energies as Energies,
    EnergyConsistent as EnergyConsistent,
    EnergyDecaying as EnergyDecaying,
    EnergyMomentumDecaying as EnergyMomentumDecaying,
    EnergyPreserving as EnergyPreserving,
    GeneralizedAlpha as GeneralizedAlpha,
    KappaDecaying as KappaDecaying,
    Rattle as Rattle,
)


__version__ = _version("enerjax")
