from .eigenvalues import eigenvalues as eigenvalues
from .equilibrium import Equilibrium as Equilibrium, equilibrium as equilibrium
from .initial import (
    consistent_start as consistent_start,
    ConsistentStart as ConsistentStart,
    initial_state as initial_state,
    start_near as start_near,
)
from .mobility import freedoms as freedoms, Mobility as Mobility, mobility as mobility
from .modes import Modes as Modes, modes as modes
from .projection import (
    project_position as project_position,
    project_velocity as project_velocity,
)
