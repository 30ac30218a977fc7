"""The numbers of a scene, which are accessed by name and stored kind by kind."""

import textwrap
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._programs import is_known
from ._frames import Numbers
from ._layout import Layout


class Parameters(eqx.Module):
    """All numbers of a scene: the `args` of its system.

    They are read like a dictionary: `args["bodies"]["crank"]["mass"]`,
    `args["joints"]["pin"]["point_b"]`, `args["forces"]["spring"]["stiffness"]` or
    `args["gravity"]`, and those that you passed to the scene as `args` by their own names.
    `set` returns a copy with other values, and `args | {"k": 2.0}` one with other numbers
    of your own. The leaves of this pytree are tables with one row for each part of a kind,
    so that a hundred rods need no larger program than one. Gradients are read by name too.
    """

    tables: dict[str, tuple[Numbers, ...]]
    own: dict[str, Any]
    layout: Layout = eqx.field(static=True)

    def keys(self) -> tuple[str, ...]:
        """The names of the sections, and of your own numbers."""
        return (*self.own, *self.tables)

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def __contains__(self, key: str) -> bool:
        return key in self.keys()

    def __getitem__(self, key: str) -> Any:
        if key in self.tables:
            return _Section(self, key)
        return _entry(self.own, key, self)

    def __setitem__(self, key: str, value: Any) -> NoReturn:
        _refuse(key)

    def __or__(self, other: Mapping[str, Any]) -> "Parameters":
        return self.set(**other) if isinstance(other, Mapping) else NotImplemented

    def __str__(self) -> str:
        lines = [f"{key} = {_text(value)}" for key, value in self.own.items()]
        for section in self.tables:
            lines += [f"{section}:", textwrap.indent(str(self[section]), "    ")]
        return "\n".join(line for line in lines if line.strip())

    def set(self, name: str | None = None, /, **numbers: Any) -> "Parameters":
        """A copy with other numbers of a part, or of your own if no name is passed.

        `args.set("crank", mass=2.0)`, `args.set(gravity=[0.0, -1.62])`. New lengths and
        points change the joints and require a new start, `scene.start(args)`.

        **Raises:** `ValueError` for a part or number that does not exist.
        """
        if name is None:
            own = {key: _like(self.own, key, value) for key, value in numbers.items()}
            return Parameters(self.tables, self.own | own, self.layout)
        places = self.layout.places
        section = next((key for key, names in places.items() if name in names), None)
        if section is None:
            raise ValueError(f"There is no part '{name}' with numbers of its own.")
        group, row = places[section][name]
        table = dict(self.tables[section][group])
        for key, value in numbers.items():
            if key not in table:
                raise ValueError(f"'{name}' has no `{key}`; it has {sorted(table)}.")
            table[key] = table[key].at[row].set(_like(self[section][name], key, value))
        groups = list(self.tables[section])
        groups[group] = table
        return Parameters(self.tables | {section: tuple(groups)}, self.own, self.layout)


def _like(old: Mapping[str, Any], key: str, value: Any) -> Any:
    """A new value with the type and shape of the old one."""
    if key not in old:
        raise ValueError(f"There is no `{key}`; there are {sorted(old)}.")
    if not eqx.is_array(old[key]):
        return value
    new = jnp.asarray(value, old[key].dtype)
    if key == "inertia" and old[key].ndim == 2 and new.shape == (3,):
        new = jnp.diag(new)  # principal moments, as bodies take them
    if key in ("GA", "EI") and new.shape == () and old[key].ndim == 1:
        new = jnp.broadcast_to(new, old[key].shape)  # for both axes, as sections take them
    if new.shape != old[key].shape:
        raise ValueError(f"`{key}` has shape {old[key].shape}, got {new.shape}.")
    return new


def _entry(entries: Mapping[str, Any], key: str, names: Iterable[str]) -> Any:
    """The entry with this name, with an error that tells the names of all."""
    if key not in entries:
        error = KeyError(key)
        error.add_note(f"There is no '{key}'; there are {sorted(names)}.")
        raise error
    return entries[key]


class _ReadOnly(Mapping):
    """A mapping that explains `Parameters.set` when it is assigned to."""

    _entries: Mapping[str, Any]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __setitem__(self, key: str, value: Any) -> NoReturn:
        _refuse(key)

    def __delitem__(self, key: str) -> NoReturn:
        _refuse(key)


def _refuse(key: str) -> NoReturn:
    raise TypeError(
        f"`args[...]['{key}']` cannot be assigned to: the `args` of a scene are read by "
        "name and changed by `args.set`, which returns new ones: "
        '`args = args.set("crank", mass=2.0)`, and without a name for your own numbers '
        "and gravity."
    )


class _Section(_ReadOnly):
    """The parts of one section by name."""

    def __init__(self, parameters: Parameters, section: str):
        self._tables = parameters.tables[section]
        self._entries = parameters.layout.places[section]

    def __getitem__(self, name: str) -> "_Part":
        group, row = _entry(self._entries, name, self)
        return _Part(jax.tree.map(lambda table: table[row], self._tables[group]))

    def __repr__(self) -> str:
        # Sections of beams have no numbers of their own.
        return "\n".join(f"{name}: {part}" for name, part in self.items() if part)


@jax.tree_util.register_pytree_node_class
class _Part(_ReadOnly):
    """The numbers of one part; a pytree, like a dictionary."""

    def __init__(self, numbers: Numbers):
        self._entries = numbers

    def __getitem__(self, name: str) -> Any:
        return _entry(self._entries, name, self)

    def __repr__(self) -> str:
        return ", ".join(f"{name} = {_text(x)}" for name, x in self.items())

    def tree_flatten(self) -> tuple[tuple[Numbers], None]:
        return (dict(self._entries),), None

    @classmethod
    def tree_unflatten(cls, _: None, numbers: tuple[Numbers]) -> "_Part":
        return cls(*numbers)


def _text(value: Any) -> str:
    """The values of an array, or its type if it is traced."""
    if isinstance(value, jax.Array) and not is_known(value):
        return str(jax.typeof(value))
    if eqx.is_array(value):
        return np.array2string(np.asarray(value), separator=", ").replace("\n", "")
    return str(value)
