"""A pendulum with a moving pivot, and the schemes that integrate it."""

import jax
import jax.numpy as jnp

import enerjax as ej


SCHEMES = {
    "preserving": (ej.EnergyPreserving(), 2),
    "preserving index3": (ej.EnergyPreserving("index3"), 2),
    "preserving gonzalez": (ej.EnergyPreserving(derivative=ej.Gonzalez()), 2),
    "consistent": (ej.EnergyConsistent(0.0), 4),
    "consistent damped": (ej.EnergyConsistent(0.5), 3),
    "decaying": (ej.EnergyDecaying(0.5, derivative=ej.MeanValue()), 2),
    "composed": (ej.Composed(ej.EnergyPreserving(), 4), 4),
}
ARGS = dict(m=1.5, g=9.81, l=1.0, r=0.3, w=5.0)


def kinetic(v, args):
    return 0.5 * args["m"] * v @ v


def potential(q, args):
    return -args["m"] * args["g"] * q[1]


def pivot(t, args):
    return jnp.stack([args["r"] * jnp.sin(args["w"] * t), 0.0 * t])


def moved_rod(q, t, args):
    rod = q - pivot(t, args)
    return jnp.array([rod @ rod - args["l"] ** 2])


DRIVEN_PENDULUM = ej.System(kinetic, potential, driven=moved_rod)


def driven_start(t=0.2, args=ARGS):
    """Horizontal, and at rest against the pivot, as far as the constraint lets it."""
    at, rate = jax.jvp(lambda t: pivot(t, args), (t,), (1.0,))
    return ej.initial_state(DRIVEN_PENDULUM, at + jnp.array([1.0, 0.0]), rate, args, t=t)
