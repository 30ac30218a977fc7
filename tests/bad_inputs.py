"""Malformed inputs with the error and a part of its message."""

import numpy as np

import enerjax as ej

from .bad_functions import ARGS, BAD_FUNCTIONS, turn


BAD = BAD_FUNCTIONS | {
    "q not finite": (dict(q=(np.nan, 0.0)), ValueError, "start is not finite"),
    "v not finite": (dict(v=(np.inf, 0.0)), ValueError, "start is not finite"),
    "q complex": (dict(q=(1j, 0.0)), (TypeError, ValueError), "real"),
    "q a scalar": (dict(q=1.0), ValueError, "vector"),
    "q a batch": (dict(q=((1.0, 0.0),)), ValueError, "vmap"),
    "q empty": (dict(q=(), v=()), ValueError, "at least one"),
    "q and v of different dtypes": (
        dict(q=np.array([1.0, 0.0], np.float32)),
        TypeError,
        "one dtype",
    ),
    "q and v of different sizes": (dict(v=(0.0, 0.0, 0.0)), ValueError, "kinematics"),
    "start a tuple": (dict(start=((1.0, 0.0), (0.0, 0.0))), TypeError, "State"),
    "h zero": (dict(h=0.0), ValueError, "positive"),
    "h negative": (dict(h=-0.01), ValueError, "positive"),
    "h not finite": (dict(h=np.nan), ValueError, "positive"),
    "h infinite": (dict(h=np.inf), ValueError, "finite"),
    "h an array": (dict(h=np.array([0.01, 0.02])), ValueError, "vmap"),
    "num_steps not whole": (dict(num_steps=4.0), ValueError, "num_steps"),
    "num_steps zero": (dict(num_steps=0), ValueError, "num_steps"),
    "no row in any steps": (dict(every=0), ValueError, "`every`"),
    "scheme a class": (dict(scheme=ej.EnergyPreserving), TypeError, "parentheses"),
    "scheme a name": (dict(scheme="ggl"), TypeError, "scheme"),
    "time not finite": (dict(t0=np.inf), ValueError, "time of the start"),
    "consistent scheme with kinematics": (
        dict(kinematics=turn, scheme=ej.EnergyConsistent(0.5)),
        ValueError,
        "kinematics",
    ),
    "args without a key": (
        dict(args=dict(m=1.0, l=1.0)),
        ValueError,
        "`potential` raised KeyError: 'g'.*the keys \\['l', 'm'\\]",
    ),
    "args forgotten": (dict(args=None), ValueError, "`args` is None here"),
    "args a list": (dict(args=[1.0, 1.0, 9.81]), ValueError, "of type list"),
    "args a string": (dict(args=ARGS | dict(g="9.81")), ValueError, "`potential` raised"),
    "args complex": (
        dict(args=ARGS | dict(g=9.81 + 1j)),
        (TypeError, ValueError),
        "`potential`",
    ),
    "args not finite": (dict(args=ARGS | dict(g=np.inf)), ValueError, "`args` holds"),
    "args not finite, by name": (
        dict(args=ARGS | dict(g=np.inf)),
        ValueError,
        r"not finite: `args\['g'\]` = inf",
    ),
    "args in single precision": (
        dict(args=ARGS | dict(g=np.array(9.81, np.float32))),
        TypeError,
        "`args\\['g'\\]` is float32 and the start is float64",
    ),
    "start in single precision": (
        dict(
            q=np.array([1, 0], np.float32),
            v=np.zeros(2, np.float32),
            args=ARGS | dict(g=np.array(9.81)),
        ),
        TypeError,
        "`args\\['g'\\]` is float64 and the start is float32",
    ),
    "args a mass for each body": (
        dict(args=ARGS | dict(m=np.array([1.0, 2.0]))),
        ValueError,
        "must return a scalar, an energy, got shape \\(2,\\)",
    ),
    "q in half precision": (
        dict(q=np.array([1, 0], np.float16), v=np.zeros(2, np.float16)),
        TypeError,
        "float16: give them as float64 or float32",
    ),
    "h a string": (dict(h="0.01"), TypeError, "`h` must be a real number"),
    "h forgotten": (dict(h=None), TypeError, "`h` must be a real number"),
    "h complex": (dict(h=0.01 + 1j), TypeError, "`h` must be a real number"),
    "time a string": (dict(t0="now"), TypeError, "must be a real number"),
    "time a vector": (dict(t0=np.zeros(2)), ValueError, "time of the start"),
    "num_steps negative": (dict(num_steps=-4), ValueError, "num_steps"),
    "num_steps a string": (dict(num_steps="4"), ValueError, "num_steps"),
    "num_steps a flag": (dict(num_steps=True), ValueError, "num_steps"),
    "start off the constraints": (
        dict(q=(2.0, 0.0)),
        RuntimeError,
        "does not satisfy the constraints",
    ),
}


# What a type checker refuses first, where the tests run under one.
WRONG_TYPES = (
    "start a tuple",
    "h an array",
    "num_steps not whole",
    "scheme a class",
    "scheme a name",
    "potential not a function",
    "constraint not a function",
    "inertia a vector",
    "q in half precision",
    "h a string",
    "h forgotten",
    "time a string",
    "time a vector",
    "num_steps a string",
    "kinetic forgotten",
    "kinetic a string",
    "force not a function",
    "driven not a function",
)
