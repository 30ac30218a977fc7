from .controller import StepController as StepController
from .simulate import simulate as simulate
