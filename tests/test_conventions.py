"""The conventions of the source."""

import ast
import importlib
import inspect
import pathlib
import pkgutil

import equinox as eqx
import pytest

import enerjax as ej

from .helpers import public_names


PACKAGE = pathlib.Path(ej.__file__).parent
SOURCES = sorted(PACKAGE.rglob("*.py"))
TESTS = sorted(pathlib.Path(__file__).parent.glob("*.py"))

# The rooms of the package; each imports only from lower ones, which stand further up.
LAYERS = [
    {"_types", "_progress"},
    {"_pictures"},
    {"_programs"},
    {"_files", "_results", "_discrete", "_solvers"},
    {"_system"},
    {"_operators"},
    {"_analysis"},
    {"schemes"},
    {"_run"},
    {"scenes"},
    {"problems"},
    {"_tools"},
    {"__main__"},
]
LAYER = {name: number for number, names in enumerate(LAYERS) for name in names}
# Types that annotations use have no docstring.
PUBLIC = {
    name: value
    for name, value in public_names().items()
    if inspect.isclass(value) or inspect.isfunction(value)
}


def part(path):
    """The module or subpackage directly below `enerjax` that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def inside(path):
    return path.relative_to(PACKAGE).with_suffix("").parts


def imports(path):
    return imports_of(path.read_text(), inside(path))


def imports_of(source, place):
    """Modules of `enerjax` and others that a source at some place imports, and the names
    it takes of them: none where it imports the module itself."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, ()) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names = tuple(alias.name for alias in node.names)
            above = ("enerjax", *place[: len(place) - node.level]) if node.level else ()
            module = ".".join((*above, *filter(None, [node.module])))
            if node.module in (None, "enerjax"):
                yield from ((f"{module}.{name}", ()) for name in names)
            else:
                yield module, names


def parts_imported(path):
    for module, _ in imports(path):
        assert module != "enerjax", "its rooms would not be seen"
        if module.startswith("enerjax."):
            yield module.split(".")[1]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    own = part(path)
    if own == "__init__":
        pytest.skip("re-exports everything")
    assert own in LAYER, f"{own} has no place among the layers"
    for other in parts_imported(path):
        assert other == own or LAYER[other] < LAYER[own], f"{path.name} imports {other}"


def files_of(name):
    return [path for path in SOURCES if part(path) == name]


def all_imports(name):
    return {module for path in files_of(name) for module, _ in imports(path)}


def test_the_imports_are_seen():
    """A parser that finds no imports would make the other tests pass."""
    assert "enerjax._operators" in all_imports("schemes")
    assert "enerjax._discrete.base" in all_imports("_discrete")
    assert "_system" in {x for path in files_of("problems") for x in parts_imported(path)}


def rooms_imported(name):
    return {x for path in files_of(name) for x in parts_imported(path)} - {name}


def test_solvers_know_no_mechanics():
    assert rooms_imported("_solvers") == {"_types", "_programs"}


def test_programs_know_nothing_else():
    assert rooms_imported("_programs") == {"_types"}


def of_solvers(source, place):
    """What a source takes from the solvers, from whichever module; `*` is all of them."""
    for module, names in imports_of(source, place):
        if module.startswith("enerjax._solvers"):
            yield from names or "*"
        elif module.startswith("enerjax."):
            owner = importlib.import_module(module) if names else None
            for name in names:
                home = getattr(getattr(owner, name), "__module__", None) or ""
                if home.startswith("enerjax._solvers"):
                    yield name


def of_libraries(source):
    """The linear algebra and the solvers of other libraries that a source names."""
    tree = ast.parse(source)
    for module, names in imports_of(source, ()):
        known = {"linalg", "optimistix", "lineax", "scipy"}
        yield from known & {*module.split("."), *names}
    attributes = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    yield from {"linalg", "scipy"} & attributes


def test_schemes_know_no_solver():
    """A scheme states equations. What it takes from linear algebra are kinds of matrices,
    and the functions of a stiffness matrix by which `EnergyConsistent` is defined."""
    schemes = {path.name: (path.read_text(), inside(path)) for path in files_of("schemes")}
    assert not [name for name, (source, _) in schemes.items() if [*of_libraries(source)]]
    taken = {(name, x) for name, source in schemes.items() for x in of_solvers(*source)}
    of_stiffness = {"as_dense", "Assembled", "cholesky", "eigh", "inverse", "product"}
    assert taken == {("energy_consistent.py", "Assembled")} | {
        ("_dissipative_stiffness.py", name) for name in of_stiffness | {"Symmetric"}
    }


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("from .._solvers import inverse", "inverse"),
        ("from .._solvers.linear.cholesky_eigh import eigh as e", "eigh"),
        ("def late():\n    from .._solvers import cholesky", "cholesky"),
        ("from .._operators.separable import schur", "schur"),
        ("from .. import _solvers", "*"),
        ("from enerjax import _solvers", "*"),
        ("import enerjax._solvers as s", "*"),
        ("import optimistix as optx", "optimistix"),
        ("from jax.scipy.linalg import cho_solve", "linalg"),
        ("from jax.numpy import linalg", "linalg"),
        ("x = jnp.linalg.solve(a, b)", "linalg"),
    ],
)
def test_a_scheme_that_knows_a_solver_is_seen(source, name):
    assert name in {*of_solvers(source, ("schemes", "rattle")), *of_libraries(source)}


def test_the_run_knows_no_scheme_by_name():
    for path in files_of("_run"):
        for module, names in imports(path):
            if module.startswith("enerjax.schemes"):
                interface = {"StepEnd", "StepProblem", "Energies"}
                assert all(x.startswith("Abstract") or x in interface for x in names)


def test_problems_are_made_of_what_users_have():
    assert rooms_imported("problems") <= {"_types", "_system", "_analysis", "scenes"}


def test_scenes_stand_on_what_users_have():
    public = {"_types", "_pictures", "_programs", "_system", "_analysis", "_run"}
    assert rooms_imported("scenes") <= public


def lines_of_code(function):
    """The length of a function without its docstring."""
    length = function.end_lineno - function.lineno + 1
    first = function.body[0]
    if ast.get_docstring(function) is not None:
        length -= first.end_lineno - first.lineno + 1
    return length


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_functions_are_short(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef):
            assert lines_of_code(node) <= 60, node.name


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_nothing_private_of_the_libraries_is_used(path):
    private = ("equinox.internal", "jax._src", "optimistix._")
    # Rules of a primitive have no other place; they are of known versions only.
    if path.parts[-2:] != ("machine_code", "calls.py"):
        private += ("jax.interpreters",)
    for module, names in imports(path):
        full = {module, *(f"{module}.{name}" for name in names)}
        assert not [x for x in full if x.startswith(private)]
    text = path.read_text()
    assert "eqx.internal" not in text
    assert "eqxi" not in text


def modules():
    names = [info.name for info in pkgutil.walk_packages([str(PACKAGE)], "enerjax.")]
    return [importlib.import_module(x) for x in names if not x.endswith("__main__")]


def classes():
    """The equinox modules that the package defines."""
    found = {
        x
        for module in modules()
        for x in vars(module).values()
        if inspect.isclass(x) and issubclass(x, eqx.Module)
    }
    ours = {x for x in found if x.__module__.startswith("enerjax")}
    return sorted(ours, key=lambda x: x.__qualname__)


def is_abstract(cls):
    return cls.__name__.lstrip("_").startswith("Abstract")


@pytest.mark.parametrize("cls", classes(), ids=lambda cls: cls.__qualname__)
def test_classes_are_abstract_or_final(cls):
    bases = [base for base in cls.__mro__[1:] if base.__module__.startswith("enerjax")]
    assert all(is_abstract(base) for base in bases), "a final class was subclassed"
    unfinished = bool(getattr(cls, "__abstractmethods__", ())) or bool(
        getattr(cls, "__abstractvars__", ())
    )
    assert unfinished == is_abstract(cls)
    for name, value in vars(cls).items():
        if not (inspect.isfunction(value) or isinstance(value, property)):
            continue
        if name.startswith("__"):
            continue
        for base in bases:
            inherited = vars(base).get(name)
            overridden = inherited is not None and not getattr(
                inherited, "__isabstractmethod__", False
            )
            assert not overridden, f"{name} of {base.__name__} is overridden"


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_have_a_docstring(name):
    value = PUBLIC[name]
    # Dataclasses write one themselves, which says nothing.
    doc = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
    assert doc
    assert not doc.startswith(f"{name.split('.')[-1]}(")
    assert doc.strip().splitlines()[0].rstrip().endswith((".", ",", ":", ";"))


def test_public_methods_have_a_docstring():
    for value in PUBLIC.values():
        if not inspect.isclass(value) or not value.__module__.startswith("enerjax"):
            continue
        for name, method in vars(value).items():
            if isinstance(method, classmethod) and not name.startswith("_"):
                assert method.__doc__, f"{value.__name__}.{name}"


def test_every_seeded_fault_can_be_seeded():
    """Its text stands once in the sources, and the tests that ought to notice it exist."""
    import seeded_faults

    assert len({fault.name for fault in seeded_faults.FAULTS}) == len(seeded_faults.FAULTS)
    for fault in seeded_faults.FAULTS:
        assert (PACKAGE / fault.file).read_text().count(fault.old) == 1, fault.name
        for place in fault.tests:
            file, _, test = place.partition("::")
            text = (TESTS[0].parent.parent / file).read_text()
            assert f"def {test.partition('[')[0]}(" in text if test else text, fault.name
