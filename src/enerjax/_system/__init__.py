from .base import (
    AbstractSystem as AbstractSystem,
    Driven as Driven,
    Force as Force,
    State as State,
)
from .canonical import (
    AbstractCanonicalSystem as AbstractCanonicalSystem,
    HamiltonianSystem as HamiltonianSystem,
    LagrangianSystem as LagrangianSystem,
)
from .elements import Elements as Elements
from .separable import System as System
