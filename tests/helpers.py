"""Problems, schemes and runs that the tests share.

Compilation dominates: runs are cached, those that differ in numbers alone share a program,
and `march` has one program for all numbers of steps.
"""

import ast
import functools
import inspect
import pathlib
import re
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej


EPS = float(np.finfo(float).eps)
HERE = pathlib.Path(__file__).parent


_BLOCK = re.compile(r"^```python([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def code_blocks(page):
    """The Python code of a page as pairs of a mark and a source, in order."""
    return [(mark.strip(), code) for mark, code in _BLOCK.findall(page.read_text())]


def code_of(page):
    """The Python code of a page of the documentation, block by block."""
    return [code for _, code in code_blocks(HERE.parent / "docs" / page)]


def public_names():
    """All public names with their values. A value can have several names."""
    found = {}
    for owner in (ej, ej.schemes, ej.scenes, ej.problems):
        for name, value in vars(owner).items():
            if not name.startswith("_") and not inspect.ismodule(value):
                found[f"{owner.__name__}.{name}"] = value
    for owner in (ej.bodies, ej.joints, ej.forces, ej.drives):
        # The modules of parts list only these.
        found |= {f"{owner.__name__}.{name}": getattr(owner, name) for name in dir(owner)}
    for name, value in vars(ej.shapes).items():
        if inspect.isclass(value) and issubclass(value, ej.shapes.AbstractShape):
            found[f"{ej.shapes.__name__}.{name}"] = value
    return found


def imported(name):
    """The modules that a file beside this one imports; fails for private names of them."""
    found = set()
    for node in ast.walk(ast.parse((HERE / name).read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not any(alias.name.startswith("_") for alias in node.names)
            found.add(node.module)
    assert not any(part.startswith("_") for module in found for part in module.split("."))
    return found


PROBLEMS = {
    "angle": ej.problems.pendulum_angle,
    "pendulum": ej.problems.pendulum,
    "double": ej.problems.double_pendulum,
    "stiff": ej.problems.stiff_double_pendulum,
    "spring": ej.problems.spring_pendulum,
    "chain": lambda: ej.problems.chain(4),
    "top": ej.problems.heavy_top,
    "body": ej.problems.free_rigid_body,
    "particles": ej.problems.four_particles,
    "double angles": ej.problems.double_pendulum_angles,
    "top directors": ej.problems.heavy_top_directors,
    "top canonical": ej.problems.heavy_top_canonical,
    "ring": ej.problems.spring_ring,
    "elastic": ej.problems.elastic_pendulum,
}

# sum m g r, the energy that a pendulum turns over: E0 is 0 in most of them.
TURNOVER = {
    "angle": 9.81,
    "pendulum": 9.81,
    "double": 9.81 * (1 + 2),
    "stiff": 9.81 * (0.005 + 2),
    "spring": 9.81,
    "top": 5436.0,
    "body": 2500.0,
    "particles": 1.1764705882352942,
}

SCHEMES = {
    "preserving": lambda alpha: ej.EnergyPreserving(),
    "preserving index3": lambda alpha: ej.EnergyPreserving("index3"),
    "preserving gauss": lambda alpha: ej.EnergyPreserving(derivative=ej.MeanValue()),
    "decaying": ej.EnergyDecaying,
    "decaying index3": lambda alpha: ej.EnergyDecaying(alpha, "index3"),
    "decaying gauss": lambda alpha: ej.EnergyDecaying(alpha, derivative=ej.MeanValue()),
    "kappa": ej.KappaDecaying,
    "consistent": ej.EnergyConsistent,
    "composed 4": lambda alpha: ej.Composed(ej.EnergyPreserving(), 4),
    "composed 6": lambda alpha: ej.Composed(ej.EnergyPreserving(), 6),
    "composed 8": lambda alpha: ej.Composed(ej.EnergyPreserving(), 8),
    "consistent 6": lambda alpha: ej.Composed(ej.EnergyConsistent(0.0), 6),
    "consistent 8": lambda alpha: ej.Composed(ej.EnergyConsistent(0.0), 8),
}


def long(names, *slow):
    """Parameters of a test, of which the slow ones are marked `slow`."""
    assert set(slow) <= set(names)
    mark = [pytest.mark.slow]
    return [pytest.param(x, marks=mark if x in slow else []) for x in names]


def chain_end(g, linear_solver, num_links):
    """The coordinates of a chain after ten steps with a linear solver of the user."""
    system, start, args = ej.problems.chain(num_links)
    run = ej.simulate(
        system,
        ej.EnergyPreserving(),
        start,
        args | {"g": g},
        h=2e-3,
        num_steps=10,
        root_finder=ej.Newton(linear_solver=linear_solver),
    )
    return run.ys.q[-1]


@functools.cache
def problem(name):
    # Kept: it must hold no numbers of a function that is being traced, and a thread of its
    # own traces none. (`jax.ensure_compile_time_eval` would compile each operation.)
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(PROBLEMS[name]).result()


@functools.cache
def solve(name, scheme, alpha=0.0, *, h, steps, save_every=1):
    """A run; its `result` tells whether it failed."""
    system, start, args = problem(name)
    solution = ej.simulate(
        system,
        SCHEMES[scheme](alpha),
        start,
        args,
        h=h,
        num_steps=steps,
        saveat=ej.SaveAt(every=save_every),
        throw=False,
    )
    return on_host(solution)


def on_host(solution):
    """The same fields as NumPy arrays, which can be indexed without compilation."""
    host = jax.device_get(solution)
    energy = np.asarray(solution.audit.energy)
    audit = SimpleNamespace(**vars(host.audit), energy=energy)
    return SimpleNamespace(**vars(host) | dict(audit=audit))


@eqx.filter_jit
def _march(system, scheme, start, args, h, steps):
    def body(_, carry):
        state, okay = carry
        out = ej.step(system, scheme, state, args, h=h)
        return out.state, okay & (out.result == ej.RESULTS.successful)

    return jax.lax.fori_loop(0, steps, body, (start, jnp.array(True)))


@functools.cache
def march(name, scheme, alpha=0.0, *, h, steps):
    """The state after some steps; the number of steps is traced."""
    system, start, args = problem(name)
    state, okay = _march(
        system, SCHEMES[scheme](alpha), start, args, jnp.asarray(h), jnp.asarray(steps)
    )
    assert okay, f"{scheme} with alpha = {alpha} on {name}, h = {h}: a step failed"
    return jax.device_get(state)


def failed(solution):
    return bool(solution.result != ej.RESULTS.successful)


def slopes(errors):
    """Orders between halvings of the step."""
    errors = np.asarray(errors)
    return np.log2(errors[:-1] / errors[1:])


def follow(system, scheme, start, args, *, h, steps, t0=0.0):
    """A run of a traced number of steps: its end, and its balance step by step.

    Returns the last state, the largest energy that no term of the balance explains, and
    the largest work of the forces in one step.
    """
    numbers = jax.tree.map(jnp.asarray, (args, h, steps, t0))
    state, leak, most, okay = _follow(system, scheme, start, *numbers)
    return eqx.error_if(state, ~okay, "a step failed"), leak, most


@eqx.filter_jit
def _follow(system, scheme, start, args, h, steps, t0):
    def body(k, carry):
        state, leak, most, okay = carry
        out = ej.step(system, scheme, state, args, h=h, t=t0 + k.astype(float) * h)
        change = system.energy(out.state, args) - system.energy(state, args)
        work = 0.0 if out.energies.work is None else out.energies.work
        driven = 0.0 if out.energies.drive_work is None else out.energies.drive_work
        unexplained = jnp.abs(change - work - driven + out.energies.dissipated)
        leak, most = jnp.maximum(leak, unexplained), jnp.maximum(most, work)
        return out.state, leak, most, okay & (out.result == ej.RESULTS.successful)

    begin = start, jnp.array(0.0), jnp.array(-jnp.inf), jnp.array(True)
    return jax.lax.fori_loop(0, steps, body, begin)
