"""Cross-sections of beams."""

from typing import Any

import equinox as eqx
import numpy as np

from .._programs import is_known, module_of
from .._types import Real, Vector
from ._arguments import number
from ._frames import Numbers


_PART = "the section"


class Section(eqx.Module):
    """The stiffness and the inertia of the cross-section of a beam.

        ej.Section(EA=2e6, GA=8e5, EI=40.0, GJ=30.0, rhoA=0.3, rhoI=1e-5)
        ej.Section.rectangle(0.02, 0.01, E=210e9, nu=0.3, rho=7850.0)

    Axis 1 of a section is along the beam, axes 2 and 3 are in the section, through its
    mass centre. In the plane, axis 2 is in the plane and axis 3 is normal to it.

    **Arguments:** all are per length of the beam, and positive.

    - `EA`: stiffness of stretch (force).
    - `GA`: stiffnesses of shear along axes 2 and 3, a pair, or a number for both (force).
      It includes the shear factor, about 5/6 for a rectangle.
    - `EI`: stiffnesses of bending about axes 2 and 3, a pair or a number (force length^2).
    - `GJ`: stiffness of torsion (force length^2); needed in space alone.
    - `rhoA`: mass per length.
    - `rhoI`: moments of inertia per length about axes 2 and 3, a pair or a number (mass
      length). The moment about axis 1 is their sum, as for a flat section; schemes that
      refuse flat bodies need three moments, the first below this sum, or a matrix `(3, 3)`.
    - `stiffness`: in place of `EA`, `GA`, `EI` and `GJ` a symmetric positive definite
      matrix, in space `(6, 6)` for (stretch, shear 2, shear 3, torsion, bending 2, bending
      3), in the plane `(3, 3)` for (stretch, shear, bending).

    **Raises:** `ValueError` for stiffnesses that are left out, and for numbers that are not
    positive.
    """

    numbers: Numbers
    outline: tuple[str, Any] | None

    def __init__(
        self,
        *,
        rhoA: Real,
        rhoI: Vector | Real,
        EA: Real | None = None,
        GA: Vector | Real | None = None,
        EI: Vector | Real | None = None,
        GJ: Real | None = None,
        stiffness: Vector | None = None,
    ):
        self.numbers = _stiffnesses(dict(EA=EA, GA=GA, EI=EI, GJ=GJ), stiffness)
        self.numbers |= dict(rhoA=_positive("rhoA", rhoA, ()), rhoI=_inertia(rhoI))
        self.outline = None

    @property
    def is_coupled(self) -> bool:
        """Whether the stiffness is a matrix."""
        return "stiffness" in self.numbers

    def in_dimension(self, beam: str, dimension: int) -> Numbers:
        """The numbers of a beam in the plane or in space, the entries of
        `args["beams"][name]`."""
        numbers = dict(self.numbers)
        if self.is_coupled:
            size = 3 * (dimension - 1)
            if numbers["stiffness"].shape != (size, size):
                raise ValueError(
                    f"`stiffness` of the section of '{beam}' must be a matrix ({size}, "
                    f"{size}) {'in the plane' if dimension == 2 else 'in space'}, got "
                    f"shape {numbers['stiffness'].shape}."
                )
        elif dimension == 3 and "GJ" not in numbers:
            raise ValueError(
                f"'{beam}' is in space and can twist: its section needs `GJ`, the "
                "stiffness of torsion."
            )
        if dimension == 2:
            return _in_plane(numbers)
        pairs = {key: numbers[key] * np.ones(2) for key in ("GA", "EI") if key in numbers}
        return numbers | pairs | dict(rhoI=_matrix(numbers["rhoI"]))

    @staticmethod
    def rectangle(
        height: Real,
        width: Real,
        *,
        E: Real,
        nu: Real,
        rho: Real,
        shear_factor: Real | None = None,
        torsion_constant: Real | None = None,
    ) -> "Section":
        """A solid rectangle of an isotropic material.

        **Arguments:**

        - `height`, `width`: the sides along axes 2 and 3 (length). In the plane the height
          is in the plane.
        - `E`, `nu`, `rho`: Young's modulus (force per area), Poisson's ratio, and the mass
          density.
        - `shear_factor`: by default `10 (1 + nu) / (12 + 11 nu)`.
        - `torsion_constant`: `J` of Saint-Venant's theory (length^4), by default from his
          series.

        **Reference:** G. R. Cowper, The shear coefficient in Timoshenko's beam theory, J.
        Appl. Mech. 33 (1966) 335-340.
        """
        height, width = _positive("height", height, ()), _positive("width", width, ())
        if shear_factor is None:
            shear_factor = 10 * (1 + nu) / (12 + 11 * nu)
        if torsion_constant is None:
            torsion_constant = _torsion_of_rectangle(height, width)
        area = height * width
        moments = area * width**2 / 12, area * height**2 / 12
        return _of_material(
            (E, nu, rho), area, moments, (shear_factor, torsion_constant),
            ("rectangle", (height, width)),
        )  # fmt: skip

    @staticmethod
    def circle(
        radius: Real, *, E: Real, nu: Real, rho: Real, shear_factor: Real | None = None
    ) -> "Section":
        """A solid circle of an isotropic material; see `rectangle`.

        The shear factor is `6 (1 + nu) / (7 + 6 nu)` by default.
        """
        return Section.tube(radius, 0.0, E=E, nu=nu, rho=rho, shear_factor=shear_factor)

    @staticmethod
    def tube(
        radius: Real,
        inner_radius: Real,
        *,
        E: Real,
        nu: Real,
        rho: Real,
        shear_factor: Real | None = None,
    ) -> "Section":
        """A circular tube of an isotropic material; see `rectangle`.

        With the ratio `m` of the radii, the shear factor is by default `6 (1 + nu) (1 +
        m^2)^2 / ((7 + 6 nu) (1 + m^2)^2 + (20 + 12 nu) m^2)`.
        """
        radius = _positive("radius", radius, ())
        inner = number(_PART, "`inner_radius`", inner_radius, (), least=0.0)
        if is_known((radius, inner)) and not inner < radius:
            raise ValueError(
                f"`inner_radius` of a tube must be below its `radius` {radius}, got "
                f"{inner}."
            )
        if shear_factor is None:
            m2 = (inner / radius) ** 2
            whole = (1 + m2) ** 2
            shear_factor = (
                6 * (1 + nu) * whole / ((7 + 6 * nu) * whole + (20 + 12 * nu) * m2)
            )
        area = np.pi * (radius**2 - inner**2)
        moment = np.pi * (radius**4 - inner**4) / 4
        return _of_material(
            (E, nu, rho), area, (moment, moment), (shear_factor, 2 * moment),
            ("circle", radius),
        )  # fmt: skip


def _of_material(
    material: tuple[Real, Real, Real],
    area: Any,
    moments: tuple[Any, Any],
    factors: tuple[Any, Any],
    outline: tuple[str, Any],
) -> Section:
    (E, nu, rho), (shear_factor, torsion_constant) = material, factors
    E, rho = _positive("E", E, ()), _positive("rho", rho, ())
    nu = number(_PART, "`nu`", nu, ())
    if is_known(nu) and not -1 < nu <= 0.5:
        raise ValueError(f"`nu`, Poisson's ratio, must be above -1 and at most 1/2: {nu}.")
    G = E / (2 * (1 + nu))
    both = module_of(moments).stack(moments)
    section = Section(
        EA=E * area,
        GA=_positive("shear_factor", shear_factor, ()) * G * area,
        EI=E * both,
        GJ=G * _positive("torsion_constant", torsion_constant, ()),
        rhoA=rho * area,
        rhoI=rho * both,
    )
    return eqx.tree_at(lambda x: x.outline, section, outline, is_leaf=lambda x: x is None)


def _torsion_of_rectangle(height: Any, width: Any) -> Any:
    """`J` by Saint-Venant's series, whose terms fall like the fifth power."""
    xp = module_of(height, width)
    long, short = xp.maximum(height, width), xp.minimum(height, width)
    odd = np.arange(1, 60, 2)
    series = xp.sum(xp.tanh(odd * np.pi * long / (2 * short)) / odd**5)
    return long * short**3 * (1 / 3 - 64 / np.pi**5 * short / long * series)


def _stiffnesses(given: dict[str, Any], stiffness: Any) -> Numbers:
    passed = {key: value for key, value in given.items() if value is not None}
    if stiffness is not None:
        if passed:
            raise ValueError(
                f"`Section` takes `stiffness` in place of {[*passed]}: pass one of them."
            )
        return dict(stiffness=_definite(stiffness))
    for key in ("EA", "GA", "EI"):
        if key not in passed:
            raise ValueError(
                f"`Section` needs `{key}`"
                + (
                    ", the stiffness of shear: these beams can be sheared. Shear factor "
                    "times G A is right; for a slender beam its value hardly matters."
                    if key == "GA"
                    else "."
                )
            )
    shapes = dict(EA=((),), GA=((), (2,)), EI=((), (2,)), GJ=((),))
    return {key: _positive(key, value, *shapes[key]) for key, value in passed.items()}


def _positive(key: str, value: Any, *shapes: tuple[int, ...]) -> Any:
    array = number(_PART, f"`{key}`", value, *shapes)
    if is_known(array) and not np.all(array > 0):
        raise ValueError(f"`{key}` of {_PART} must be positive, got {value}.")
    return array


def _definite(matrix: Any) -> Any:
    array = number(_PART, "`stiffness`", matrix, (3, 3), (6, 6))
    if is_known(array):
        size = np.abs(array).max()
        if np.abs(array - array.T).max() > 1e-9 * size:
            raise ValueError("`stiffness` of the section is not symmetric.")
        scale = np.sqrt(np.abs(np.diag(array)))
        if not scale.all() or np.linalg.eigvalsh(array / np.outer(scale, scale))[0] <= 0:
            raise ValueError(
                "`stiffness` of the section is not positive definite: some strain would "
                "cost no energy."
            )
    return array


def _inertia(rhoI: Any) -> Any:
    array = number(_PART, "`rhoI`", rhoI, (), (2,), (3,), (3, 3))
    if not is_known(array):
        return array
    moments = np.linalg.eigvalsh(_matrix(array))
    if not moments[0] > 0 or moments[2] > (1 + 1e-9) * (moments[0] + moments[1]):
        raise ValueError(
            f"No section has the `rhoI` {array.tolist()}: moments of inertia are positive, "
            "and none is above the sum of the other two."
        )
    return array


def _matrix(rhoI: Any) -> Any:
    """The moments of inertia per length as a matrix."""
    xp = module_of(rhoI)
    if rhoI.shape == (3, 3):
        return rhoI
    if rhoI.shape == (3,):
        return xp.diag(rhoI)
    pair = rhoI * np.ones(2)
    return xp.diag(xp.concatenate([xp.sum(pair)[None], pair]))


def _in_plane(numbers: Numbers) -> Numbers:
    """The numbers of a beam in the plane, where axis 3 is normal to it."""
    found = {key: x for key, x in numbers.items() if key != "GJ"}
    rhoI = numbers["rhoI"]
    found["rhoI"] = rhoI[2, 2] if rhoI.ndim == 2 else rhoI[..., -1] if rhoI.ndim else rhoI
    for key, axis in (("GA", 0), ("EI", 1)):
        if key in found and found[key].ndim == 1:
            found[key] = found[key][axis]
    return found
