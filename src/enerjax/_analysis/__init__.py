from .equilibrium import Equilibrium as Equilibrium, equilibrium as equilibrium
from .mobility import freedoms as freedoms, Mobility as Mobility, mobility as mobility
from .modes import Modes as Modes, modes as modes
