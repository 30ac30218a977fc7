"""Discrete gradients by the chain rule, of random compositions of JAX functions.

`D . (b - a) = f(b) - f(a)` to round-off, and `D = grad f` at `b = a`.
"""

import functools
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from fuzz_case import Result
from numpy.random import Generator

import enerjax as ej


SIZE, POINTS, DRAWS = 6, 4, 5
INCREMENTS = (3.0, 1e-2, 1e-6, 1e-11, 0.0)
MATRIX = np.random.default_rng(2).normal(size=(SIZE, SIZE)) / 2


def _spd(x):
    root = jnp.outer(jnp.sin(x), jnp.cos(x[::-1])) + 0.5 * jnp.outer(x, x) / (1 + x @ x)
    return 2 * jnp.eye(SIZE) + root @ root.T


@jax.custom_jvp
def _soft(x):
    return jnp.sqrt(1 + x * x) - 1


_soft.defjvp(lambda at, along: (_soft(at[0]), at[0] / jnp.sqrt(1 + at[0] ** 2) * along[0]))


@jax.custom_vjp
def _bump(x):
    return jnp.exp(-x * x)


_bump.defvjp(
    lambda x: (_bump(x), x), lambda x, pulled: (-2 * x * jnp.exp(-x * x) * pulled,)
)


def _newton_root(x):
    """Three iterations for the cube root, in a counted loop."""
    target = 2 + jnp.tanh(x)
    return jax.lax.fori_loop(0, 3, lambda _, y: y - (y - target / y**2) / 3, target)


def _scan(x):
    body = lambda carry, y: (jnp.sin(carry + y), carry * y)
    last, rows = jax.lax.scan(body, x[0], x)
    return rows + last


def _attract(x):
    """A function of all pairs of points in space, by an inner `vmap`."""
    points = x.reshape(2, 3)
    near = lambda a: jax.vmap(lambda b: 1 / (0.3 + jnp.sum((a - b) ** 2)))(points)
    return x * jnp.sum(jax.vmap(near)(points)) / 4


UNARY: dict[str, Callable] = {
    "where": lambda x: jnp.where(x > 0.1, jnp.sin(x), 0.1 * x**2),
    "guarded": lambda x: jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), x),
    "select": lambda x: jnp.select([x < -0.5, x < 0.5], [-x, x**3], jnp.cos(x)),
    "piecewise": lambda x: jnp.piecewise(x, [x < 0], [jnp.sin, jnp.tanh]),
    "norm": lambda x: x / (0.5 + jnp.linalg.norm(x)),
    "norm of differences": lambda x: jnp.abs(x) * jnp.linalg.norm(x[:3] - x[3:]),
    "norm 1": lambda x: jnp.cos(x) * jnp.linalg.norm(x, ord=1) / 3,
    "log": lambda x: jnp.log(0.2 + x**2),
    "logsumexp": lambda x: x - jax.nn.logsumexp(x),
    "softmax": lambda x: jax.nn.softmax(x) * jnp.sin(x),
    "log softmax": jax.nn.log_softmax,
    "custom jvp": _soft,
    "custom vjp": _bump,
    "sort": lambda x: jnp.sort(x) * jnp.cos(x),
    "argsort": lambda x: x[jnp.argsort(jnp.sin(x))] / 2,
    "top": lambda x: jnp.append(jax.lax.top_k(x, 3)[0], x[:3]),
    "median": lambda x: x - jnp.median(x),
    "cumsum": lambda x: jnp.cumsum(x) / 2,
    "cumprod": lambda x: jnp.cumprod(1 + 0.5 * jnp.sin(x)),
    "cummax": lambda x: jax.lax.cummax(x) - x / 2,
    "cumlogsumexp": lambda x: jax.lax.cumlogsumexp(x) / 2,
    "fori": _newton_root,
    "scan": _scan,
    "map": lambda x: jax.lax.map(lambda y: y * jnp.cos(y), x),
    "associative": lambda x: jax.lax.associative_scan(jnp.multiply, jnp.cos(x)),
    "switch": lambda x: jax.lax.switch(
        jnp.floor(2 * jnp.abs(x[0])).astype(int), [jnp.sin, jnp.cos, lambda y: y / 2], x
    ),
    "cholesky": lambda x: jnp.linalg.cholesky(_spd(x)) @ x / 3,
    "solve": lambda x: jnp.linalg.solve(_spd(x), x),
    "inverse": lambda x: jnp.linalg.inv(_spd(x))[0] + x / 2,
    "eigenvalues": lambda x: jnp.linalg.eigvalsh(_spd(x)) * x / 3,
    "singular values": lambda x: jnp.linalg.svd(_spd(x), compute_uv=False) + x,
    "slogdet": lambda x: jnp.linalg.slogdet(_spd(x))[1] * jnp.sin(x),
    "qr": lambda x: jnp.linalg.qr(_spd(x))[1] @ x / 4,
    "expm": lambda x: jax.scipy.linalg.expm(0.2 * jnp.outer(jnp.sin(x), jnp.cos(x)))[0],
    "matrix power": lambda x: jnp.linalg.matrix_power(_spd(x) / 3, 3)[0] / 4 + x / 2,
    "convolve": lambda x: jnp.convolve(x, jnp.array([0.2, 0.5, -0.3]), mode="same"),
    "interpolate": lambda x: jnp.interp(x, jnp.linspace(-4, 4, 9), jnp.arange(9.0) % 3),
    "angle": lambda x: jnp.arctan2(x, 1.5 + x[::-1] ** 2),
    "sinc": jnp.sinc,
    "gamma": lambda x: jax.scipy.special.gammaln(1.5 + x * x),
    "erf": jax.scipy.special.erf,
    "bessel": lambda x: jax.scipy.special.i0e(x),
    "polynomial": lambda x: jnp.polyval(jnp.array([0.1, -0.2, 1.0]), jnp.tanh(x)),
    "vmap": _attract,
    "outer": lambda x: jnp.einsum("i,j,ij->i", x, jnp.cos(x), jnp.asarray(MATRIX)),
    "scatter": lambda x: jnp.zeros(SIZE).at[jnp.array([0, 0, 3, 5, 5, 1])].add(x),
    "scatter max": lambda x: (x / 2).at[jnp.array([1, 4, 2])].max(x[:3]),
    "segments": lambda x: jax.ops.segment_sum(
        x, jnp.array([0, 1, 1, 2, 3, 3]), num_segments=SIZE
    ),
    "roll": lambda x: jnp.roll(x, 2) * x,
    "rounded": lambda x: x - 0.5 * jnp.round(x),
    "floor": lambda x: jnp.floor(x) + jnp.sin(x),
    "remainder": lambda x: jnp.mod(x, 1.3),
    "sign": lambda x: jnp.sign(x) * jnp.sqrt(0.1 + jnp.abs(x)),
    "power": lambda x: (0.3 + jnp.abs(x)) ** 1.7,
    "variance": lambda x: jnp.sin(x) * jnp.std(x + jnp.arange(SIZE, dtype=x.dtype)),
    "quaternion": lambda x: jnp.append(
        jnp.cross(x[:3], x[3:]), x[:3] / jnp.sqrt(0.1 + x[:3] @ x[:3])
    ),
    "stop": lambda x: x * jax.lax.stop_gradient(jnp.cos(1.0)),
    "kept": jax.checkpoint(lambda x: jnp.sin(x) * jnp.cos(x[::-1])),
    "gradient": jax.grad(lambda x: jnp.sum(jnp.sin(x) ** 2 * x[::-1]) / 2),
    "nested": lambda x: jax.jit(lambda y: jnp.where(y > 0, jax.jit(jnp.sin)(y), y))(x),
}


def build(names: tuple[str, ...], joins: tuple[int, ...]) -> Callable:
    """A scalar function; `noise` changes every intermediate value relatively."""

    def program(x, noise):
        values = [x]
        for name, join, eps in zip(names, joins, noise, strict=True):
            before = values[-1 - join % len(values)] * (1 + eps[0])
            values.append(UNARY[name](before) * (1 + eps[1]))
        return jnp.sum(values[-1] * jnp.tanh(values[len(values) // 2]))

    return program


def cases(rng: Generator, number: int) -> Iterator[tuple[str, Callable[[], Result]]]:
    """A random program; in the first blocks it consists of a single function."""
    known = sorted(UNARY)
    for draw in range(DRAWS):
        place = number * DRAWS + draw
        depth = int(rng.integers(2, 5))
        names = [str(name) for name in rng.choice(known, depth)]
        if place < len(known):
            names = [known[place]]
        joins = tuple(int(k) for k in rng.integers(0, 3, len(names)))
        own = np.random.default_rng(rng.integers(2**63))
        label = "alone" if len(names) == 1 else f"depth {len(names)}"
        yield label, functools.partial(check, own, tuple(names), joins)


def check(rng: Generator, names: tuple[str, ...], joins: tuple[int, ...]) -> Result:
    function = build(names, joins)
    silent = jnp.zeros((len(names), 2, SIZE))
    a = rng.normal(size=(POINTS, len(INCREMENTS), SIZE))
    b = a + np.asarray(INCREMENTS)[:, None] * rng.normal(size=a.shape)
    a, b = (jnp.asarray(x.reshape(-1, SIZE)) for x in (a, b))
    program = jax.jit(jax.vmap(functools.partial(_defects, function, silent)))
    defect, slope, closed = jax.device_get(program(a, b))
    same = np.all(np.asarray(a == b), axis=1)
    slope = np.where(same, slope, 0.0)
    found, measures = [], {}
    named = {"identity": defect, "slope at D(a, a)": slope, "identity of Gonzalez": closed}
    for what, value in named.items():
        measures[what] = float(np.max(value))
        worst = int(np.argmax(np.where(np.isnan(value), np.inf, value)))
        if not value[worst] <= 100:
            increment = INCREMENTS[worst % len(INCREMENTS)]
            told = " > ".join(names) + f" {joins}"
            found.append(f"{what} off by {value[worst]:.1e} units at {increment}: {told}")
    return Result(found, measures)


def _defects(function, silent, a, b):
    """In units of the error by rounding each intermediate value once."""
    value = lambda x: function(x, silent)
    derivative = ej.discrete_grad(value)(a, b)
    size = jnp.zeros(())
    for x in (a, b):
        by_input, by_noise = jax.grad(function, argnums=(0, 1))(x, silent)
        size += jnp.sum(jnp.abs(by_noise)) + jnp.abs(by_input) @ jnp.abs(x)
        size += jnp.abs(value(x))
    # A product passes between the points: large at one, times large at the other.
    both = ej.discrete_grad(lambda inputs: function(*inputs))((a, silent), (b, silent))
    size += jnp.sum(jnp.abs(both[1])) + jnp.abs(both[0]) @ (jnp.abs(a) + jnp.abs(b))
    unit = jnp.finfo(float).eps * size
    defect = lambda gradient: jnp.abs(gradient @ (b - a) - (value(b) - value(a))) / unit
    slope = jax.grad(value)(a)
    apart = jnp.max(jnp.abs(derivative - slope)) / jnp.max(jnp.abs(slope) + size)
    closed = defect(ej.Gonzalez().gradient(value, a, b))
    return defect(derivative), apart / jnp.finfo(float).eps, closed
