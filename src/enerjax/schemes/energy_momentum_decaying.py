import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._operators import (
    AbstractModel,
    ChordTerms,
    DelassusMatrix,
    Increment,
    Reaction,
    Strains,
)
from .._programs import is_known
from .._system import State
from .._types import JointMultipliers, Multipliers, Real, Scalar, Velocities
from ._arguments import alpha_from_spectral_radius, as_alpha
from ._chord import elastic_length, step_chord, velocities_of_nodes
from .base import AbstractSchemeWithRotations, Formulation, StepEnd, StepProblem


class _Unknowns(eqx.Module):
    """The unknowns of a step.

    - `strain_impulse`: the impulses `s`, scaled.
    - `jump`: its `velocity_impulse` is the reaction `kappa` of the joints to the impulses
      `s` at the start; its other fields are empty.
    - `end`: the increment to the end of the step.
    """

    strain_impulse: Float[Array, " ns"]
    jump: Increment
    end: Increment


class _Problem(eqx.Module):
    """The data of a step, with the scales of the impulses `s` and of their rows."""

    step: StepProblem
    scale: Float[Array, " ns"]
    row_scale: Float[Array, " ns"]

    @property
    def strains(self) -> Strains:
        return Strains(self.step.separable_model)


class _Jumps(eqx.Module):
    """What the unknowns say of the jumps.

    - `impulse`: `s`, the jump of the momentum of each strain.
    - `strain`: `g`, the jump of each strain.
    - `velocity`: `M^-1 (Gamma'^T s - C^T kappa)`, the jump of the velocities.
    """

    impulse: Float[Array, " ns"]
    strain: Float[Array, " ns"]
    velocity: Velocities


def _correction(
    problem: _Problem,
    rows: _Unknowns,
    impulse: Float[Array, " ns"],
    reaction: JointMultipliers,
    end: Increment,
) -> _Unknowns:
    """The scaled correction: impulses of the strains, the reaction to them, and the end."""
    jump = eqx.tree_at(lambda jump: jump.velocity_impulse, rows.jump, reaction)
    return _Unknowns(impulse / problem.scale, jump, end)


class EnergyMomentumDecaying(AbstractSchemeWithRotations[_Unknowns, _Problem]):
    r"""Scheme that damps fast vibrations and conserves linear and angular momentum.

    It damps the strains `Gamma(q)` of springs and beams, whose energy is
    `Gamma . K Gamma / 2`. A step has one interval, with multipliers of the strains and of
    their rates beside those of the constraints:

        z1 - z0 = h J D[H + lambda . Phi + eta . psi + K g / 2 . Gamma + s / 2 . dGamma/dt]
        s       = (h/6) K (Gamma_1 - Gamma_0 - alpha g)
        g       = -(h/6) ((dGamma/dt)_1 - (dGamma/dt)_0 - alpha G s)
        E1      = E0 - alpha/2 (g . K g + s . G s)

    `G` is the mobility of the strains at the start: `G s` are the rates of the strains that
    the impulses `s` cause while the joints hold. Rigid motions do not change strains, and
    all terms are discrete gradients of functions of strains, so they conserve momenta.

    - Conserves: linear and angular momentum, to round-off, for any step length, where
      forces, constraints and the rest of the potential permit it; energy at `alpha = 0`.
      Strains must be functions of distances and of dot products, also of directors; with
      cross products in space, such as areas, it is conserved to second order.
    - Dissipates: `alpha/2 (g . K g + s . G s)`, which is never negative where `K` is
      positive semidefinite. On a linear oscillator `rho_inf = (1 - alpha) / (1 + alpha)`.
      Only strains are damped: not the rest of the potential, such as gravity, `Potential`s
      and nonlinear springs of a scene and contacts, and not the vibrations of constraints.
    - Constraints held at: position and velocity level.
    - Order: 2. Symmetric at `alpha = 0`, where it conserves what `EnergyPreserving` does,
      by other equations: `Composed` raises its order. Forces enter as in that scheme.
    - Rigid bodies (`rigid_bodies` of a `System`) are moved by rotations, as in
      `EnergyPreserving`.
    - Requires a potential with strains: that of a scene with springs or beams, or
      `Elements.from_strains`; constant inertia, and no `kinematics`.

    **Arguments:**

    - `alpha`: the dissipation, in [0, 1]. It can be traced, swept and differentiated.

    Raises a `ValueError` for a known `alpha` outside [0, 1], and for a system without
    strains, with varying inertia or with `kinematics`.

    **Reference:** new here. Related methods: F. Armero and I. Romero (2001), for
    unconstrained bodies; E. Lens and A. Cardona, section 5.2, whose scheme this is on a
    linear oscillator.
    """

    alpha: Scalar
    # Determined at construction: under transformations of JAX `alpha` may be traced.
    is_preserving: bool = eqx.field(static=True)

    def __init__(self, alpha: Real):
        self.alpha = as_alpha(alpha)
        # Compared in NumPy, because under `jit` a comparison of JAX arrays is traced.
        self.is_preserving = is_known(self.alpha) and not np.any(np.asarray(self.alpha))

    @classmethod
    def from_spectral_radius(cls, rho_inf: Real) -> "EnergyMomentumDecaying":
        """The scheme with spectral radius `rho_inf`, in [0, 1], at infinite frequency."""
        return cls(alpha_from_spectral_radius(rho_inf))

    @property
    def formulation(self) -> Formulation:
        return "ggl"

    @property
    def symmetric(self) -> bool:
        return self.is_preserving

    @property
    def order(self) -> int:
        return 2

    @property
    def chord_terms(self) -> tuple[ChordTerms, ...]:
        return (("strains",),)

    def problem(self, model: AbstractModel, start: State, h: Scalar) -> _Problem:
        if model.has_own_momenta or not model.in_rates.has_canonical_rates:
            has = "varying inertia or a Hamiltonian"
            if not model.has_own_momenta:
                has = "`kinematics`"
            raise ValueError(
                "`EnergyMomentumDecaying` needs constant inertia and velocities that are "
                f"the rates of the coordinates, and this system has {has}. Use "
                "`EnergyDecaying`, or describe rotations by directors (`bodies.RigidBody`, "
                "`rigid_bodies` of a `System`)."
            )
        step = StepProblem(model, start, h, is_one_interval=True)
        strains = Strains(step.separable_model)
        if strains.count == 0:
            raise ValueError(
                "`EnergyMomentumDecaying` damps strains, and this system has none: its "
                "potential does not tell any. Those of a scene are told by `Spring`, "
                "`TorsionSpring` and beams. Otherwise `potential` itself must be the value "
                "of `Elements.from_strains`, or a sum of such `Elements`, and not a "
                "function that calls it. Without strains "
                "`EnergyPreserving` conserves the same momenta, and `EnergyConsistent` "
                "damps any potential."
            )
        root = jnp.sqrt(model.energy_scale(start, h))
        unit = root * strains.scales(start.q)
        stiff = jnp.abs(h / 6 * strains.stresses(jnp.abs(h) * unit))
        scale = root**2 / unit
        return _Problem(step, *jax.lax.stop_gradient((scale, scale + stiff)))

    def predict(
        self, problem: _Problem, acceleration: Velocities, multipliers: Multipliers
    ) -> _Unknowns:
        end = problem.step.guess(acceleration, multipliers)
        none = jnp.zeros((0,), end.rate.dtype)
        jump = Increment(none, none, none, jnp.zeros_like(end.velocity_impulse))
        return _Unknowns(jnp.zeros_like(problem.scale), jump, end)

    def residual(self, z: _Unknowns, problem: _Problem) -> _Unknowns:
        step, strains = problem.step, problem.strains
        model, start, h = step.separable_model, step.start, step.h
        end, jumps = self._end_and_jumps(z, problem)
        gradient = step.discrete_gradient(start, end, z.end)
        gradient = gradient.less(step.step_load(end, z.end))
        stresses = strains.stresses(jumps.strain)
        terms = strains.gradient(
            start, end, h * z.end.rate, h / 2 * stresses, h / 2 * jumps.impulse
        )
        change = strains.change(start.q, end.q, step.displacement(z.end))
        moved = change - self._alpha(h) * jumps.strain
        of_strains = jumps.impulse - h / 6 * strains.stresses(moved)
        held = model.joint_change(start.q, jumps.velocity, start.t)
        return _Unknowns(
            strain_impulse=of_strains / problem.row_scale,
            jump=eqx.tree_at(lambda jump: jump.velocity_impulse, z.jump, held),
            end=step.rows(z.end, end, gradient.plus(*terms)),
        )

    def delassus_matrix(self, z: _Unknowns, problem: _Problem) -> DelassusMatrix:
        elastic = elastic_length(self.alpha, problem.step.h)
        return problem.step.delassus_matrix(z.end, elastic)

    def chord(
        self, rows: _Unknowns, problem: _Problem, delassus: DelassusMatrix
    ) -> _Unknowns:
        if delassus.elastic is not None:
            return self._elastic_chord(rows, problem, delassus)
        # Without stiffness the rows of the strains determine their impulses, and these move
        # the velocities at the end of the step and the joints.
        impulse = problem.row_scale * rows.strain_impulse
        momentum = problem.strains.momentum(problem.step.start.q, impulse)
        moved = delassus.product(delassus.inverse_inertia @ momentum)
        end = eqx.tree_at(
            lambda z: (z.rate, z.velocity_impulse),
            rows.end,
            (rows.end.rate + momentum, rows.end.velocity_impulse + moved),
        )
        (reaction,) = delassus.solve((moved - rows.jump.velocity_impulse)[None])
        return _correction(problem, rows, impulse, reaction, step_chord(end, delassus))

    def _elastic_chord(
        self, rows: _Unknowns, problem: _Problem, delassus: DelassusMatrix
    ) -> _Unknowns:
        """The correction with the stiffness of the strains.

        The velocities `v1` of the end and the jump `w` of the velocities by the strains
        have the equations of the nodes of `EnergyDecaying`; see `_chord.py`.
        """
        step, strains, end = problem.step, problem.strains, rows.end
        h, alpha, inverse = step.h, self._alpha(step.h), delassus.inverse_inertia
        # The strains change with the position, which is predicted at the middle.
        middle = step.start.q + 0.5 * h * step.model.lift(step.start.q, step.start.v)
        own, slip = problem.row_scale * rows.strain_impulse, end.velocity_impulse
        right = (end.impulse - 0.5 * slip, rows.jump.velocity_impulse)
        moving, jumping = map(delassus.velocity, delassus.solve(jnp.stack(right)))

        def impulse_and_force(change: Array, strain: Array) -> tuple[Array, Velocities]:
            impulse = h / 6 * strains.stresses(change - alpha * strain)
            stress = strains.stresses(change + strain)
            return impulse, strains.momentum(middle, h / 2 * stress)

        # The part of the strains that the constraints of the velocities cause.
        rates = lambda velocity: strains.rates(middle, velocity)
        held = h * rates(moving), alpha * h / 6 * rates(jumping)
        impulse, force = impulse_and_force(*held)
        pushed = inverse @ strains.momentum(middle, own + impulse)
        free = inverse @ (end.rate - force)
        right = (delassus.product(pushed), delassus.product(free) - slip)
        at_jump, at_end = delassus.solve(jnp.stack(right))
        nodes = free - delassus.velocity(at_end), pushed - delassus.velocity(at_jump)
        (v1, jump), _ = velocities_of_nodes(alpha, jnp.stack(nodes), delassus)
        change = held[0] + h / 2 * rates(v1 + jump)
        strain = held[1] - h / 6 * rates(v1 - alpha * jump)
        impulse, force = impulse_and_force(change, strain)
        impulse = own + impulse
        moved = delassus.product(inverse @ strains.momentum(middle, impulse))
        reactions = (
            delassus.product(inverse @ (end.rate - force)) - slip,
            moved - rows.jump.velocity_impulse,
            end.impulse - 0.5 * (slip + moved),
        )
        multipliers, at_start, reaction = delassus.solve(jnp.stack(reactions))
        found = eqx.tree_at(
            lambda z: (z.impulse, z.rate, z.velocity_impulse),
            end,
            (multipliers, 0.5 * (v1 + jump) + moving, reaction),
        )
        return _correction(problem, rows, impulse, at_start, found)

    def finish(self, z: _Unknowns, problem: _Problem) -> StepEnd:
        step, strains = problem.step, problem.strains
        end, jumps = self._end_and_jumps(z, problem)
        size = jumps.strain @ strains.stresses(jumps.strain)
        size = size + jumps.velocity @ (step.separable_model.inertia @ jumps.velocity)
        drive_work = step.drive_work(step.start, end, z.end)
        return StepEnd(
            state=end,
            displacement=step.displacement(z.end),
            multipliers=z.end.impulse / step.h,
            energies=step.account(
                0.5 * self._alpha(step.h) * size, step.step_work(end, z.end), drive_work
            ),
        )

    def _end_and_jumps(self, z: _Unknowns, problem: _Problem) -> tuple[State, _Jumps]:
        step, strains = problem.step, problem.strains
        model, start, h = step.separable_model, step.start, step.h
        q1, t1 = step.position(z.end), step.end_time
        impulse = problem.scale * z.strain_impulse
        by_strains = model.inverse_inertia @ strains.mean_momentum(
            start.q, q1, h * z.end.rate, 0.5 * impulse
        )

        def velocity(reaction: Reaction) -> tuple[Velocities]:
            added = reaction((start.q, start.t), (q1, t1), z.end.velocity_impulse)
            return (2 * (step.velocity(z.end) - added - by_strains) - start.v,)

        (end,) = step.nodes(velocity, (z.end, t1))
        jump = model.inverse_inertia @ strains.momentum(start.q, impulse)
        jump = jump - model.reaction_at(start.q, start.t, z.jump.velocity_impulse)
        change = strains.rates(q1, end.v) - strains.rates(start.q, start.v)
        own = strains.rates(start.q, jump)
        return end, _Jumps(
            impulse=impulse,
            strain=-h / 6 * (change - self._alpha(h) * own),
            velocity=jump,
        )

    def _alpha(self, like: Scalar) -> Scalar:
        return self.alpha.astype(like.dtype)
