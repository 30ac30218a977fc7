"""Schemes cannot be made from numbers that they are not defined for."""

import pytest

import enerjax as ej


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ej.EnergyDecaying(-0.1), "alpha"),
        (lambda: ej.EnergyDecaying(1.1), "alpha"),
        (lambda: ej.EnergyDecaying(float("nan")), "alpha"),
        (lambda: ej.KappaDecaying(2.0), "alpha"),
        (lambda: ej.EnergyConsistent(-1e-9), "alpha"),
        (lambda: ej.EnergyDecaying.from_spectral_radius(1.5), "rho_inf"),
        (lambda: ej.EnergyConsistent.from_spectral_radius(-0.5), "rho_inf"),
        (lambda: ej.Composed(ej.EnergyDecaying(0.5), 4), "symmetric"),
        (lambda: ej.Composed(ej.EnergyDecaying(0.0), 4), "symmetric"),
        (lambda: ej.Composed(ej.KappaDecaying(0.0), 4), "symmetric"),
        (lambda: ej.Composed(ej.EnergyConsistent(0.5), 6), "symmetric"),
        (lambda: ej.Composed(ej.EnergyPreserving(), 5), "order"),
        (lambda: ej.Composed(ej.EnergyPreserving(), 2), "order"),
        (lambda: ej.Composed(ej.EnergyConsistent(0.0), 4), "order"),
        (lambda: ej.MeanValue(points=0), "points"),
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
def test_a_scheme_cannot_be_made_from_what_it_does_not_know(make, message, is_type_checked):
    if is_type_checked:
        pytest.skip("the type checker refuses it first")
    with pytest.raises(ValueError, match=message):
        make()
