from .labelled import Sweep as Sweep
from .sweep import sweep as sweep
