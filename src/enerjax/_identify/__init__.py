from .estimate import Fit as Fit
from .fit import fit as fit
from .shooting import multiple_shooting as multiple_shooting
