"""Schemes refuse parameters for which they are not defined."""

import jax
import jax.numpy as jnp
import pytest

import enerjax as ej

from .helpers import problem


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ej.EnergyDecaying(-0.1), "alpha"),
        (lambda: ej.EnergyDecaying(1.1), "alpha"),
        (lambda: ej.EnergyDecaying(float("nan")), "alpha"),
        (lambda: ej.KappaDecaying(2.0), "alpha"),
        (lambda: ej.EnergyConsistent(-1e-9), "alpha"),
        (lambda: ej.EnergyMomentumDecaying(1.5), "alpha"),
        (lambda: ej.EnergyDecaying.from_spectral_radius(1.5), "rho_inf"),
        (lambda: ej.EnergyConsistent.from_spectral_radius(-0.5), "rho_inf"),
        (lambda: ej.Composed(ej.EnergyDecaying(0.5), 4), "symmetric"),
        (lambda: ej.Composed(ej.EnergyDecaying(0.0), 4), "symmetric"),
        (lambda: ej.Composed(ej.KappaDecaying(0.0), 4), "symmetric"),
        (lambda: ej.Composed(ej.EnergyConsistent(0.5), 6), "symmetric"),
        (lambda: ej.Composed(ej.EnergyMomentumDecaying(0.5), 4), "symmetric"),
        (lambda: ej.Composed(ej.EnergyPreserving(), 5), "order"),
        (lambda: ej.Composed(ej.EnergyPreserving(), 2), "order"),
        (lambda: ej.Composed(ej.EnergyConsistent(0.0), 4), "order"),
        (lambda: ej.MeanValue(points=0), "points"),
        (lambda: ej.Newton(rtol=-1.0), "rtol"),
        (lambda: ej.Newton(atol=float("nan")), "atol"),
    ],
)
def test_a_scheme_cannot_be_made_from_bad_numbers(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ej.EnergyPreserving("index2"), "formulation"),  # pyright: ignore
        (lambda: ej.EnergyDecaying(0.5, "GGL"), "formulation"),  # pyright: ignore
        (
            lambda: ej.Composed(ej.Composed(ej.EnergyPreserving(), 4), 6),  # pyright: ignore
            "symmetric",
        ),
    ],
)
def test_unknown_formulations_are_refused(make, message, is_type_checked):
    if is_type_checked:
        pytest.skip("the type checker refuses it first")
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("alpha", ["1", 1j])
def test_a_dissipation_is_a_real_number(alpha, is_type_checked):
    if is_type_checked:
        pytest.skip("the type checker refuses it first")
    for scheme in (
        ej.EnergyDecaying, ej.EnergyConsistent, ej.EnergyMomentumDecaying, ej.KappaDecaying
    ):  # fmt: skip
        with pytest.raises(TypeError, match=r"real number in \[0, 1\], got"):
            scheme(alpha)


@pytest.mark.parametrize("scheme", [ej.EnergyPreserving, ej.EnergyConsistent])
def test_a_derivative_without_parentheses(scheme, is_type_checked):
    if is_type_checked:
        pytest.skip("the type checker refuses it first")
    numbers = () if scheme is ej.EnergyPreserving else (0.5,)
    with pytest.raises(TypeError, match="parentheses"):
        scheme(*numbers, derivative=ej.ChainRule)  # pyright: ignore


def test_the_arguments_of_a_step_must_fit(is_type_checked):
    system, start, args = problem("pendulum")
    one = ej.step(system, ej.EnergyPreserving(), start, args, h=0.01)
    with pytest.raises(ValueError, match="`warm` is not of this scheme"):
        ej.step(system, ej.EnergyDecaying(0.5), start, args, h=0.01, warm=one.warm)
    if is_type_checked:
        pytest.skip("the type checker refuses the rest first")
    with pytest.raises(TypeError, match="root finder"):
        ej.step(
            system,
            ej.EnergyPreserving(),
            start,
            args,
            h=0.01,
            root_finder=ej.Newton,  # pyright: ignore
        )


def test_numbers_inside_jit_are_checked_where_they_are_constants(is_type_checked):
    system, start, args = problem("pendulum")

    @jax.jit
    def run(h):
        scheme = ej.Composed(ej.EnergyConsistent(0.0), 6)
        return ej.simulate(system, scheme, start, args, h=h, num_steps=2).ys.q

    assert bool(jnp.all(jnp.isfinite(run(0.01))))
    with pytest.raises(ValueError, match="alpha"):
        jax.jit(lambda h: ej.EnergyDecaying(-1.0).alpha * h)(0.1)
    if is_type_checked:
        pytest.skip("the type checker refuses the rest first")
    vector = ej.EnergyDecaying(jnp.array([0.1, 0.2]))
    with pytest.raises(ValueError, match=r"jax\.vmap"):
        ej.simulate(system, vector, start, args, h=0.01, num_steps=2)
