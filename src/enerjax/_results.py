"""The outcomes of a step. A failure is a value that each step of each lane returns."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._types import Flag


class RESULTS(eqx.Enumeration):
    """The outcome of a step or of a run; the message of a failure names its remedy."""

    successful = "successful"
    not_converged = (
        "Newton's method did not converge. The step may be too long for the motion: "
        "reduce `h`, let failed steps be divided (`max_halvings=4`), or let a "
        "`StepController` choose the steps. In derivatives steps are divided only if "
        "`max_halvings` is given. Vibrations of stiff springs that no step can "
        "resolve are damped by `EnergyConsistent(1.0)` or `EnergyDecaying(1.0)`."
    )
    singular = (
        "The step equations became singular. Constraints may be redundant (declare "
        "`System(..., redundant=True)`; `enerjax.mobility` names them), or the mechanism "
        "passes a pose where they lose their independence: another `h` may avoid it."
    )
    nonfinite = (
        "The step equations became non-finite. A function of the system may be undefined "
        "there (a division by zero, a root of a negative number), or `h` is far too long."
    )
    step_too_large = (
        "A constraint turned by more than a right angle in this step: the step is far too "
        "long for the motion, or ended in a solution on the wrong side of a joint. Reduce "
        "`h`, or let failed steps be divided: `max_halvings=3`."
    )
    inconsistent_start = (
        "The start does not satisfy the constraints that this scheme enforces. Create it "
        "with `initial_state(system, q, v, args)`, which projects it onto them."
    )
    kappa_out_of_range = (
        "kappa left (0, 2): the kinetic energy hardly changed in this step, and kappa is "
        "defined by a division by that change, so nothing bounds the energy any more. "
        "This is a limit of the scheme, not of the step: use `EnergyDecaying` or "
        "`EnergyConsistent`."
    )
    out_of_steps = (
        "The run did not reach its end time within `max_steps`. Raise `max_steps`, "
        "lengthen `h`, or loosen the tolerances of the controller."
    )
    steps_too_short = (
        "The controller asks for steps that are negligible beside the length of the run. "
        "Loosen `rtol` and `atol`: they must stay above the residual of Newton's method, "
        "about 1e-14 of the coordinates. Or the motion has a singularity here, such as a "
        "collision."
    )
    event_not_found = (
        "A function of an event passes a zero in this step, but no step ends there. The "
        "function may jump, such as an angle that is reduced to a turn, or may touch zero "
        "again and again: write it as a smooth function."
    )
    too_many_events = (
        "More events happened than `max_events`. Raise `max_events` if they are wanted. "
        "Bounces that become ever shorter have no end: let a terminal event end the run "
        "before, or lengthen the run only to where they accumulate."
    )
    gap_closed_at_start = (
        "The gap of an `Impact` is negative at the start, or it is zero and does not open. "
        "Start with open gaps, or with gaps that are zero and at rest and have a "
        "restitution below 1: after elastic impacts nothing rests."
    )
    impacts_unresolved = (
        "After an event the gap of an `Impact` is negative or still closes. Either a reset "
        "has closed it, or impacts happened at once that do not end if they are applied "
        "one after another: change their order, or let them happen one by one."
    )
    inconsistent_reset = (
        "After a `reset` or `reset_args` of an event the state does not satisfy the "
        "constraints. It must do so in positions and velocities, with the new `args`."
    )
    restitution_out_of_range = (
        "The restitution of an `Impact` is not between 0 and 1 for these `args`."
    )
    invalid_energy = (
        "The kinetic energy is not `1/2 v . M v` with symmetric positive definite `M`, or "
        "not that of the `rigid_bodies`. The same call outside of `jit` and `vmap` says "
        "what is wrong."
    )
    invalid_step = (
        "The step `h`, or the time from `t0` to `t1`, is not positive and finite. Outside "
        "of `jit` and `vmap` such a call raises an error."
    )
    angle_jumped = (
        "The angle of a torsion spring in space passed half a turn, where its energy is "
        "not smooth. Such an angle counts from the start pose, that of a spring in a file "
        "from its value without force: let the range of the motion lie around it. Angles "
        "of bodies in the plane are not limited."
    )
    interrupted = (
        "The run was interrupted. The same call with `resume=solution`, or with the same "
        "`checkpoint`, makes the rest."
    )


# As they are written in files; an enumeration does not list its names.
_NAMES = (
    "successful",
    "not_converged",
    "singular",
    "nonfinite",
    "step_too_large",
    "inconsistent_start",
    "kappa_out_of_range",
    "out_of_steps",
    "steps_too_short",
    "event_not_found",
    "too_many_events",
    "gap_closed_at_start",
    "impacts_unresolved",
    "inconsistent_reset",
    "restitution_out_of_range",
    "invalid_energy",
    "invalid_step",
    "angle_jumped",
    "interrupted",
)


def first_failure(old: RESULTS, new: RESULTS) -> RESULTS:
    """`old` if it is a failure, else `new`."""
    return RESULTS.where(old == RESULTS.successful, new, old)


def from_root_finder(found: Flag, broken: Flag, finite: Flag) -> RESULTS:
    """The outcome of a step: whether a root was found, whether the iteration broke down,
    and whether its residual was finite."""
    breakdown = RESULTS.where(finite, RESULTS.singular, RESULTS.nonfinite)
    failure = RESULTS.where(broken, breakdown, RESULTS.not_converged)
    return RESULTS.where(found, RESULTS.successful, failure)


# The failures of a step that Newton's method may mend.
_OF_SEARCH = (
    RESULTS.not_converged,
    RESULTS.singular,
    RESULTS.nonfinite,
    RESULTS.step_too_large,
)


def may_need_newton(result: RESULTS) -> Flag:
    """Whether a step without Newton's method may have failed for want of it."""
    return functools.reduce(jnp.logical_or, (result == failure for failure in _OF_SEARCH))


def first_of(results: RESULTS) -> RESULTS:
    """The first failure along the leading axis of stacked results."""
    failed = results != RESULTS.successful
    first = jnp.argmax(failed)
    return jax.tree.map(lambda x: x[first], results)


def meanings(outcomes: RESULTS) -> np.ndarray:
    """The first words of the message of each outcome, in an array of their shape."""
    (codes,) = jax.tree.leaves(outcomes)
    known, positions = np.unique(codes, return_inverse=True)
    # `str` is the only way to a message that works for every enumeration of optimistix.
    texts = [str(jax.tree.map(lambda _, c=c: np.asarray(c), outcomes)) for c in known]
    messages = [x.partition("<")[2].removesuffix(">") or "successful" for x in texts]
    words = np.array([x.partition(". ")[0].partition(":")[0] for x in messages])
    return words[positions].reshape(np.shape(codes))


def names_of(outcomes: RESULTS) -> Any:
    """The name of an outcome; of several the lists of their names."""
    (codes,) = jax.tree.leaves(outcomes)
    known = {_code(name): name for name in _NAMES}
    return jax.tree.map(lambda code: known[code], np.asarray(codes).tolist())


def from_names(names: Any) -> RESULTS:
    """The inverse of `names_of`."""
    codes = jax.tree.map(_code, names)
    return jax.tree.map(lambda x: jnp.asarray(codes, x.dtype), RESULTS.successful)


def _code(name: str) -> int:
    (code,) = jax.tree.leaves(getattr(RESULTS, name))
    return int(code)


def tally(outcomes: RESULTS) -> str:
    """The outcomes, counted: `3 successful, 1 Newton's method did not converge`."""
    causes, numbers = np.unique(meanings(outcomes), return_counts=True)
    return ", ".join(f"{n} {c}" for n, c in zip(numbers, causes, strict=True))
