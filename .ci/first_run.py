"""A first run of the installed package, away from its sources."""

from pathlib import Path

import jax

import enerjax as ej


jax.config.update("jax_enable_x64", True)
assert "site-packages" in Path(ej.__file__).parts
assert (Path(ej.__file__).parent / "py.typed").exists()
system, start, args = ej.problems.pendulum()
sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=0.01, num_steps=100)
assert sol.audit.energy.size == 101
assert abs(sol.audit.energy - sol.audit.energy[0]).max() < 1e-12
print(f"enerjax {ej.__version__} of {Path(ej.__file__).parent}: {sol.result}")
