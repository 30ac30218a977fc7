"""The equations of a root between vectors, which its search and its derivatives share."""

from collections.abc import Callable
from typing import Any

import lineax as lx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._programs import call_traced_once
from .linear.dense import SMALL
from .linear.elimination_order import Owners
from .linear.jacobian import Form, form_of, Linearisable, regularised
from .linear.user_solver import AbstractSparseSolver


class Equations:
    """Equations between trees as a function of vectors, with their exact Jacobian.

    It is constructed at trace time. The search for a root and the derivatives of the root
    use one object, so that the form of the Jacobian is searched for once, and the program
    of its entries is traced once.

    - `fn`: `fn(y, args)`, whose traced values must all be in `args`.
    - `unravel`: makes a tree of the unknowns from the vector.

    The other arguments are those of `form_of`.
    """

    def __init__(
        self,
        fn: Callable[[PyTree[Array], Any], PyTree[Array]],
        like: PyTree[Array],
        linear_solver: lx.AbstractLinearSolver | AbstractSparseSolver | None = None,
        *,
        owners: Owners | None = None,
        rarely: bool = False,
        small: int = SMALL,
    ):
        self.fn = fn
        self.unravel = ravel_pytree(like)[1]
        self._linear_solver, self._owners = linear_solver, owners
        self._rarely, self._small = rarely, small
        self._form: Form | None = None

    def flat(self, x: Float[Array, " n"], args: Any) -> Float[Array, " m"]:
        """The equations between vectors."""
        return ravel_pytree(self.fn(self.unravel(x), args))[0]

    def linearisable(
        self,
        like: Float[Array, " n"],
        args: Any,
        regularisation: Float[Array, " n"] | None = None,
    ) -> Linearisable:
        """The equations with these arguments as a function of the unknowns."""
        if self._form is None:
            self._form = form_of(
                regularised(lambda x: self.flat(x, args), regularisation),
                like,
                self._linear_solver,
                owners=self._owners,
                rarely=self._rarely,
                small=self._small,
            )
        inputs = self._form, self.flat, args, regularisation
        jacobian = lambda x: call_traced_once(_jacobian, x, *inputs)
        value = lambda x: self.flat(x, args)
        return Linearisable(value, jacobian, self._form, regularisation)


def _jacobian(
    x: Float[Array, " n"],
    form: Form,
    flat: Callable[[Array, Any], Array],
    args: Any,
    regularisation: Float[Array, " n"] | None,
) -> Array:
    return form.evaluate(regularised(lambda x: flat(x, args), regularisation), x)
