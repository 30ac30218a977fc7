from .audit import Audit as Audit
from .controller import StepController as StepController
from .events import (
    AbstractEvent as AbstractEvent,
    Event as Event,
    Events as Events,
    Impact as Impact,
)
from .inputs import positive_integer as positive_integer
from .reached import (
    must_be_close as must_be_close,
    must_be_known as must_be_known,
    ReachedRows as ReachedRows,
    warn_if_visible as warn_if_visible,
)
from .saving import SaveAt as SaveAt
from .simulate import simulate as simulate
from .solution import Solution as Solution, Statistics as Statistics
from .solution_file import load as load, save as save
from .step import step as step, StepOutput as StepOutput, Warm as Warm
from .step_sizes import AbstractController as AbstractController, EqualSteps as EqualSteps
