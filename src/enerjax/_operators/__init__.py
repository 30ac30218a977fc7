from .._system import AbstractCanonicalSystem, AbstractSystem, State, System
from .._types import Args
from .base import AbstractModel as AbstractModel, Reaction as Reaction
from .canonical import CanonicalModel as CanonicalModel
from .delassus import DelassusMatrix as DelassusMatrix
from .interval import Gradient as Gradient, Increment as Increment, Time as Time
from .scaling import (
    local_error as local_error,
    roughness as roughness,
    scales_like as scales_like,
    shortened as shortened,
)
from .separable import SeparableModel as SeparableModel
from .strains import Strains as Strains


def has_strains(model: AbstractModel) -> bool:
    """Whether the chord method includes the stiffness of strains, and there are any."""
    return isinstance(model, SeparableModel) and model.elastic_tables is not None


def make_model(
    system: AbstractSystem,
    state: State,
    args: Args,
    *,
    rotates_in: tuple[int, ...] = (),
    elastic: bool = False,
) -> AbstractModel:
    """The model of a system. The scales are those at `state`, which is a user's state.

    It must be made in a program that JAX traces: numbers that are known and zero would
    count as zero in every state, and be missing in the patterns of Jacobians.

    Rigid bodies in the dimensions `rotates_in` are moved by rotations; if it is `elastic`,
    the chord method includes the stiffness of strains. See `SeparableModel`.
    """
    if isinstance(system, AbstractCanonicalSystem):
        return CanonicalModel(system, state, args)
    assert isinstance(system, System)
    return SeparableModel(system, state, args, rotates_in=rotates_in, elastic=elastic)
