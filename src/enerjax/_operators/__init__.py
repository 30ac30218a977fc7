from .._system import AbstractCanonicalSystem, AbstractSystem, State, System
from .._types import Args
from .base import AbstractModel as AbstractModel, Reaction as Reaction
from .canonical import CanonicalModel as CanonicalModel
from .delassus import DelassusMatrix as DelassusMatrix
from .elastic import ChordTerms as ChordTerms
from .interval import Gradient as Gradient, Increment as Increment, Time as Time
from .scaling import (
    local_error as local_error,
    roughness as roughness,
    scales_like as scales_like,
    shortened as shortened,
)
from .separable import FEW_FREE as FEW_FREE, SeparableModel as SeparableModel
from .strains import Strains as Strains


def terms_of_chord(model: AbstractModel) -> ChordTerms:
    """The terms of stiffness and damping that the chord method includes."""
    if not isinstance(model, SeparableModel) or model.elastic_tables is None:
        return ()
    return model.elastic_tables.terms


def make_model(
    system: AbstractSystem,
    state: State,
    args: Args,
    *,
    rotates_in: tuple[int, ...] = (),
    chord_terms: tuple[ChordTerms, ...] = (),
) -> AbstractModel:
    """The model of a system. The scales are those at `state`, which is a user's state.

    It must be made in a program that JAX traces: numbers that are known and zero would
    count as zero in every state, and be missing in the patterns of Jacobians.

    Rigid bodies in the dimensions `rotates_in` are moved by rotations. The chord method
    includes the first of `chord_terms` that the system has. See `SeparableModel`.
    """
    if isinstance(system, AbstractCanonicalSystem):
        return CanonicalModel(system, state, args)
    assert isinstance(system, System)
    return SeparableModel(
        system, state, args, rotates_in=rotates_in, chord_terms=chord_terms
    )
