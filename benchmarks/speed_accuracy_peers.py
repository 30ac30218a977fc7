"""Other programs on the problems of `speed_accuracy.py`.

Each yields its rows, or none if it is not installed."""

# pyright: reportArgumentType=false, reportMissingImports=false, reportAttributeAccessIssue=false

import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from references import HEAVY_TOP
from scipy.integrate import solve_ivp
from speed_accuracy_works import BOUND, G, Work

import enerjax as ej


Rows = Iterator[dict[str, Any]]
Run = Callable[[], np.ndarray]


def _timed(prepare: Callable[[], Run], repeats: int) -> tuple[np.ndarray, float]:
    """The positions at the end, and the seconds of a run without its preparation."""
    end, times = prepare()(), []
    for _ in range(repeats):
        run = prepare()
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return end, statistics.median(times)


def _row(
    kind: str,
    solver: str,
    setting: str,
    work: Work,
    exact: np.ndarray,
    prepare: Callable[[], Run],
    repeats: int,
) -> Rows:
    """No time is reported for a wrong result."""
    try:
        q, seconds = _timed(prepare, repeats)
    except Exception as error:
        print(f"{solver}, {setting}: {str(error)[:80]}")
        return
    error = work.error(q, exact)
    if error <= BOUND:
        yield dict(kind=kind, solver=solver, setting=setting, error=error, seconds=seconds)


def scipy_rows(work: Work, exact: np.ndarray, repeats: int) -> Rows:
    """DOP853: the top in minimal coordinates, chains with their tensions solved for."""
    try:
        import speed_accuracy_compiled as compiled
    except ImportError:
        return
    if work.is_top:
        args = {k: np.asarray(x) for k, x in ej.problems.heavy_top().args.items()}
        rates, y0 = lambda t, y: HEAVY_TOP.rates(y, args), HEAVY_TOP.start(args)
        position = lambda y: HEAVY_TOP.as_state(y, args)[0][:3]
    else:
        masses = np.array(work.masses)
        rates, y0 = lambda t, y: compiled.rates(y, masses), _start(work)
        position = lambda y: y[: 2 * work.size]
    for tolerance in (1e-4, 1e-6, 1e-8, 1e-10):

        def run(tolerance=tolerance) -> np.ndarray:
            options = dict(method="DOP853", rtol=tolerance, atol=tolerance)
            return position(solve_ivp(rates, (0, work.end), y0, **options).y[:, -1])

        solver = f"SciPy DOP853, {'minimal' if work.is_top else 'index 1'}"
        setting = f"rtol {tolerance:g}"
        yield from _row("ode", solver, setting, work, exact, lambda run=run: run, repeats)


def _start(work: Work) -> np.ndarray:
    y = np.zeros((2, work.size, 2))
    y[0, :, 0] = work.length * np.arange(1, work.size + 1)
    return y.ravel()


def swing(t: Any, y: Any, args: Any) -> Any:
    """Angles from the horizontal and rates of one or two points; gravity acts along +y."""
    size = y.size // 2
    angle, rate = y[:size], y[size:]
    if size == 1:
        return jnp.append(rate, G * jnp.cos(angle))
    m1, m2 = args
    delta = angle[0] - angle[1]
    coupling, twist = m2 * jnp.cos(delta), m2 * jnp.sin(delta)
    a, b = (m1 + m2), m2
    f = -twist * rate[1] ** 2 + a * G * jnp.cos(angle[0])
    g = twist * rate[0] ** 2 + b * G * jnp.cos(angle[1])
    determinant = a * b - coupling**2
    return jnp.stack(
        [*rate, (b * f - coupling * g) / determinant, (a * g - coupling * f) / determinant]
    )


def diffrax_rows(work: Work, exact: np.ndarray, repeats: int) -> Rows:
    """Tsit5 and Dopri8, in minimal coordinates and on our own model."""
    try:
        import diffrax
    except ImportError:
        return
    forms: list[tuple[str, Any, Any, Any, Callable]] = []
    if work.size in (1, 2):
        term = diffrax.ODETerm(swing)
        y0, args = jnp.zeros(2 * work.size), jnp.array(work.masses)
        forms.append(("minimal", term, y0, args, lambda y: _points(y[: work.size])))
    if work.is_top:
        term, args = diffrax.ODETerm(spin), ej.problems.heavy_top().args
        y0 = jnp.array([1.0, 0.0, 0.0, 0.0, 0.0, 150.0, -4.61538])
        position = lambda y: turned(y[:4], args["centre"])
        forms.append(("minimal", term, y0, args, position))
    system, start, given = work.problem()
    term, y0 = ej.to_diffrax(system, start, given)
    forms.append(("index 1", term, y0, None, lambda y: work.positions(y[0])))
    for form, term, y0, args, position in forms:
        for method in (diffrax.Tsit5(), diffrax.Dopri8()):
            for tolerance in (1e-4, 1e-6, 1e-8, 1e-10):

                @jax.jit
                def solve(y0, tolerance, term=term, method=method, args=args):
                    return diffrax.diffeqsolve(
                        term,
                        method,
                        0.0,
                        work.end,
                        None,
                        y0,
                        args,
                        saveat=diffrax.SaveAt(t1=True),
                        stepsize_controller=diffrax.PIDController(tolerance, tolerance),
                        max_steps=10**6,
                        adjoint=diffrax.ForwardMode(),
                    ).ys

                def run(
                    solve=solve, y0=y0, tolerance=tolerance, position=position
                ) -> np.ndarray:
                    end = jax.tree.map(lambda y: y[0], solve(y0, tolerance))
                    return np.asarray(position(end))

                solver = f"diffrax {type(method).__name__}, {form}"
                setting = f"rtol {tolerance:g}"
                yield from _row(
                    "ode", solver, setting, work, exact, lambda run=run: run, repeats
                )


def turned(p: Any, x: Any) -> Any:
    """A vector of the body in space; `p` is the unit quaternion of the body."""
    twice = 2 * jnp.cross(p[1:], x)
    return x + p[0] * twice + jnp.cross(p[1:], twice)


def spin(t: Any, y: Any, args: Any) -> Any:
    """The heavy top about its fixed point: a quaternion and the angular velocity."""
    p, spin = y[:4], y[4:]
    m, centre = args["m"], args["centre"]
    about_tip = jnp.diag(args["J"]) + m * (
        centre @ centre * jnp.eye(3) - jnp.outer(centre, centre)
    )
    back = p * jnp.array([1.0, -1.0, -1.0, -1.0])
    weight = turned(back, jnp.array([0.0, 0.0, -m * args["g"]]))
    torque = jnp.cross(centre, weight) - jnp.cross(spin, about_tip @ spin)
    turn = 0.5 * jnp.append(-p[1:] @ spin, p[0] * spin + jnp.cross(p[1:], spin))
    return jnp.concatenate([turn, jnp.linalg.solve(about_tip, torque)])


def _points(angles: Any) -> Any:
    links = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    return jnp.cumsum(links, axis=0).reshape(-1)


def ida_rows(work: Work, exact: np.ndarray, repeats: int) -> Rows:
    """IDA on the equations stabilised as by Gear, Gupta and Leimkuhler."""
    try:
        import speed_accuracy_compiled as compiled
        from sksundae.ida import IDA
    except ImportError:
        return
    if work.is_top:
        return
    size, masses = work.size, np.array(work.masses)

    def residual(t: float, y: np.ndarray, rate: np.ndarray, out: np.ndarray) -> None:
        compiled.residual(y, rate, masses, work.length, out)

    y0, rate0 = np.zeros((size, 6)), np.zeros((size, 6))
    y0[:, 0] = work.length * np.arange(1, size + 1)
    rate0[:, 3] = G
    algebraic = [6 * k + j for k in range(size) for j in (4, 5)]
    band = dict(linsolver="band", lband=11, uband=11) if size > 2 else {}
    # With many points small tolerances are not reached, or take minutes.
    tolerances = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
    for tolerance in tolerances[: 5 if size <= 2 else 4 if size <= 8 else 2]:
        bounds = np.full(y0.size, tolerance)
        # Multipliers are left out of the error test.
        bounds[algebraic] = 1e6 * tolerance
        options = dict(rtol=tolerance, atol=bounds, algebraic_idx=algebraic)
        solver = IDA(residual, max_num_steps=10**6, **options, **band)

        def run(solver=solver) -> np.ndarray:
            out = solver.solve([0.0, work.end], y0.ravel(), rate0.ravel())
            if not out.success:
                raise RuntimeError(out.message)
            return out.y[-1].reshape(size, 6)[:, :2].ravel()

        yield from _row(
            "dae", "IDA", f"rtol {tolerance:g}", work, exact, lambda run=run: run, repeats
        )


def exudyn_rows(work: Work, exact: np.ndarray, repeats: int) -> Rows:
    """The generalized-alpha method, rho 0.9 for few points and 0.5 for chains; the
    trapezoidal rule of index 2."""
    try:
        import chain_exudyn
        import step_cost_exudyn
    except ImportError:
        return
    rho = 0.9 if work.size <= 2 else 0.5
    kinds = {"generalized-alpha": rho} | ({} if work.is_top else {"trapezoidal": None})
    for kind, rho in kinds.items():
        for h in (4e-3, 1e-3, 2.5e-4, 1e-4):

            def prepare(h=h, rho=rho) -> Run:
                if work.is_top:
                    run = step_cost_exudyn.prepared_top(h, work.end)
                else:
                    run = chain_exudyn.prepared(work.masses, work.length, h, work.end, rho)
                return lambda: run()[0]

            solver, setting = f"EXUDYN {kind}", f"h {h:g}"
            yield from _row("dae", solver, setting, work, exact, prepare, repeats)


SOLVERS = (scipy_rows, ida_rows, exudyn_rows)
