from .estimate import Fit as Fit
from .fit import fit as fit
from .shooting import MultipleShooting as MultipleShooting
