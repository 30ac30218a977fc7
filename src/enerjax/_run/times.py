"""The two ways to say how long a run is: a number of steps, or a time."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .._programs import is_known
from .._types import Real, Scalar, Times
from .inputs import positive_integer


def check_form(
    num_steps: Any, save_every: Any, t1: Any, ts: Any, max_steps: Any, controller: Any
) -> None:
    """That one of the two forms is given, whole."""
    of_time = {"ts": ts, "max_steps": max_steps, "controller": controller}
    given = [name for name, x in of_time.items() if x is not None]
    by_steps = num_steps is not None and t1 is None and not given
    by_time = num_steps is None and t1 is not None and save_every == 1
    if by_steps or by_time:
        return
    known = {"num_steps": num_steps, "t1": t1} | of_time
    names = [name for name, x in known.items() if x is not None]
    names += ["save_every"] if t1 is not None and save_every != 1 else []
    raise ValueError(
        "Say how long the run is in one of two ways: a number of steps, `num_steps` (with "
        "`save_every`), or a time, `t1` (with `ts`, `max_steps` and `controller`). Got "
        + (", ".join(f"`{name}`" for name in names) if names else "neither")
        + "."
    )


def check_times(
    t0: Real, t1: Real, ts: Any, dtype: Any
) -> tuple[Scalar, Times | str | None]:
    """The end time, and where rows are wanted: times, `"steps"`, or `None`."""
    if jnp.ndim(t1) != 0 or (is_known((t0, t1)) and not _real(t0) < _real(t1) < np.inf):
        raise ValueError(
            f"`t1` must be a finite time after the start of the run, got t1 = {t1} with "
            f"t0 = {t0}."
        )
    end = jnp.asarray(t1, dtype)
    if ts is None:
        return end, None
    if isinstance(ts, str):
        if ts != "steps":
            raise ValueError(f'`ts` must be times or "steps", got {ts!r}.')
        return end, ts
    times = jnp.asarray(ts, dtype)
    if times.ndim != 1 or times.size == 0:
        raise ValueError(
            f"`ts` must be a vector of times, shape (times,), got shape {times.shape}."
        )
    if is_known((t0, t1, ts)):
        first, last = _real(t0), _real(t1)
        room = 1e-6 * (last - first) if dtype == jnp.float32 else 1e-12 * (last - first)
        values = np.asarray(ts, float)
        inside = np.all((values >= first - room) & (values <= last + room))
        if not inside or np.any(np.diff(values) < 0):
            raise ValueError(
                f"`ts` must be ascending times from t0 = {t0} to t1 = {t1}, got {ts}."
            )
    return end, times


def bound_on_steps(max_steps: Any, needed: Any) -> int:
    """`max_steps`, or without it the number of steps that are needed, if that is known."""
    if max_steps is not None:
        return positive_integer("max_steps", max_steps)
    if not is_known(needed):
        raise ValueError(
            "`max_steps` is missing: with `h`, `t0` or `t1` traced by a transformation the "
            "number of steps is not known when the program is made. Give a bound, such as "
            "the number of steps at the shortest `h`."
        )
    return int(needed)


def _real(number: Real) -> float:
    return float(np.real(number))
