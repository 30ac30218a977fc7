from .base import (
    AbstractSystem as AbstractSystem,
    Driven as Driven,
    Force as Force,
    order_for as order_for,
    State as State,
    Symmetry as Symmetry,
)
from .canonical import (
    AbstractCanonicalSystem as AbstractCanonicalSystem,
    HamiltonianSystem as HamiltonianSystem,
    LagrangianSystem as LagrangianSystem,
)
from .checks.shapes import describe as describe, energies as energies
from .checks.system import (
    check_not_varying as check_not_varying,
    check_number as check_number,
    check_system as check_system,
)
from .checks.values import (
    check_without_rotations as check_without_rotations,
    closes_over_traced_values as closes_over_traced_values,
    direction_without_symmetry as direction_without_symmetry,
    has_valid_energy as has_valid_energy,
)
from .damping import AbstractDampedForce as AbstractDampedForce
from .elements import Elements as Elements
from .kinematics import (
    AbstractKinematics as AbstractKinematics,
    ByRates as ByRates,
    Frames as Frames,
    mean_momentum as mean_momentum,
    Rates as Rates,
    RigidBodies as RigidBodies,
    RigidKinematics as RigidKinematics,
)
from .names import Names as Names
from .separable import System as System
from .strains import (
    AbstractStrainEnergy as AbstractStrainEnergy,
    StrainArrays as StrainArrays,
)
