"""How a step can end. Failures are values: each step of each lane carries one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._types import Flag


class RESULTS(eqx.Enumeration):
    """The outcome of a step or of a run; the message says what to do about it."""

    successful = "successful"
    not_converged = (
        "Newton's method did not converge. The step may be too long for the motion: "
        "reduce `h`, or let steps that fail be divided: `max_halvings=4`, or let a "
        "`StepController` choose the steps. Vibrations of stiff springs that no step can "
        "resolve are damped by `EnergyConsistent(1.0)` or `EnergyDecaying(1.0)`."
    )
    singular = (
        "The step equations became singular. Constraints may repeat each other (declare "
        "that: `System(..., redundant=True)`; `enerjax.mobility` names their rows), or the "
        "mechanism passes a pose where they lose their independence: another `h` may miss "
        "it."
    )
    nonfinite = (
        "The step equations became non-finite. A function of the system may be undefined "
        "there (a division by zero, a root of a negative number), or `h` is far too long."
    )
    step_too_large = (
        "A constraint turned by more than a right angle in this step: the step is far too "
        "long for the motion, or has met a solution on the other side of a joint. Reduce "
        "`h`, or let steps that fail be divided: `max_halvings=3`."
    )
    inconsistent_start = (
        "The start does not satisfy the constraints that this scheme holds. Make it "
        "with `initial_state(system, q, v, args)`, which projects it onto them."
    )
    kappa_out_of_range = (
        "kappa left (0, 2): the kinetic energy hardly changed in this step, and kappa is "
        "defined by a division by that change, so that nothing bounds the energy any "
        "more. This is a limit of the scheme, not of the step: use `EnergyDecaying` or "
        "`EnergyConsistent`."
    )
    out_of_steps = (
        "The end time is not reached within `max_steps`. Raise `max_steps`, lengthen `h`, "
        "or loosen the tolerances of the controller."
    )
    steps_too_short = (
        "The tolerances of the controller ask for steps that vanish beside the length of "
        "the run. Loosen `rtol` and `atol`: what Newton's method leaves, about 1e-14 of "
        "the coordinates, is not below any tolerance; or the motion has a singularity "
        "here (a collision)."
    )


def first_failure(old: RESULTS, new: RESULTS) -> RESULTS:
    """`old` unless it is a success."""
    return RESULTS.where(old == RESULTS.successful, new, old)


def from_root_finder(found: Flag, broken: Flag, finite: Flag) -> RESULTS:
    """What the end of an iteration, with a finite residual or not, means for a step."""
    breakdown = RESULTS.where(finite, RESULTS.singular, RESULTS.nonfinite)
    failure = RESULTS.where(broken, breakdown, RESULTS.not_converged)
    return RESULTS.where(found, RESULTS.successful, failure)


def first_of(results: RESULTS) -> RESULTS:
    """The first failure along the leading axis of stacked results."""
    failed = results != RESULTS.successful
    first = jnp.argmax(failed)
    return jax.tree.map(lambda x: x[first], results)


def meanings(outcomes: RESULTS) -> np.ndarray:
    """What each outcome means, in a few words, in an array of their shape."""
    (codes,) = jax.tree.leaves(outcomes)
    known, places = np.unique(codes, return_inverse=True)
    # The only name of an outcome that all enumerations show is their text for one.
    texts = [str(jax.tree.map(lambda _, c=c: np.asarray(c), outcomes)) for c in known]
    told = [text.partition("<")[2].removesuffix(">") or "successful" for text in texts]
    words = np.array([text.partition(". ")[0].partition(":")[0] for text in told])
    return words[places].reshape(np.shape(codes))


def tally(outcomes: RESULTS) -> str:
    """How often each outcome occurs: `3 successful, 1 Newton's method did not converge`."""
    causes, numbers = np.unique(meanings(outcomes), return_counts=True)
    return ", ".join(f"{n} {c}" for n, c in zip(numbers, causes, strict=True))
