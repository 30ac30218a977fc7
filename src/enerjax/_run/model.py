"""The model of a system that a scheme moves."""

from .._operators import AbstractModel, make_model
from .._system import AbstractSystem, State
from .._types import Args
from ..schemes import (
    AbstractScheme,
    AbstractSchemeWithChord,
    AbstractSchemeWithRotations,
)


def model_for(
    scheme: AbstractScheme,
    system: AbstractSystem,
    state: State,
    args: Args,
    *,
    omits_dampers: bool = False,
) -> AbstractModel:
    """The model of a system for a scheme, which may move rigid bodies by rotations, and may
    include stiffness and damping in its chord method."""
    stage = scheme.stage
    has_rotations = isinstance(stage, AbstractSchemeWithRotations)
    rotates_in = stage.rotates_in if has_rotations else ()
    terms = stage.chord_terms if isinstance(stage, AbstractSchemeWithChord) else ()
    if omits_dampers:
        terms = tuple(x for x in terms if "dampers" not in x)
    return make_model(system, state, args, rotates_in=rotates_in, chord_terms=terms)
