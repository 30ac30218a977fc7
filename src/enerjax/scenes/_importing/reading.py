"""Reads a file with MuJoCo's parser."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from . import mujoco


# What the parser reads as a mesh.
_MESHES = (".stl", ".obj", ".msh")
# In URDF a link without inertia has none, whatever its shapes are, and shapes are to be
# seen. Files may say otherwise, in an element that only MuJoCo reads.
_COMPILER = dict(discardvisual="false", fusestatic="false", inertiafromgeom="false")


def read_mjcf(path: Path) -> Any:
    """The compiled model of an MJCF file."""
    _root(path, "mujoco", "from_urdf")
    with _told_by_parser(path):
        return mujoco.MjSpec.from_file(str(path)).compile()


def read_urdf(path: Path, ignore: frozenset[str]) -> Any:
    """The compiled model of a URDF file."""
    root = _root(path, "robot", "from_mjcf")
    _resolve_meshes(root, path, "meshes" in ignore)
    options = root.find("mujoco")
    if options is None:
        options = ElementTree.SubElement(root, "mujoco")
    compiler = options.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(options, "compiler")
    for key, value in _COMPILER.items():
        compiler.set(key, compiler.get(key, value))
    with _told_by_parser(path):
        text = ElementTree.tostring(root, encoding="unicode")
        return mujoco.MjSpec.from_string(text).compile()


def _root(path: Path, tag: str, other: str) -> ElementTree.Element:
    """The outermost element of a file, which tells its format."""
    if not path.is_file():
        raise FileNotFoundError(f"There is no file '{path}'.")
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"'{path}' is no XML: {error}.") from None
    if root.tag != tag:
        known = {"mujoco": "MJCF", "robot": "URDF"}
        hint = f": use `{other}`" if root.tag in known else ""
        raise ValueError(
            f"'{path}' is no {known[tag]} file, whose outermost element is <{tag}>; it is "
            f"<{root.tag}>{hint}."
        )
    return root


@contextmanager
def _told_by_parser(path: Path) -> Iterator[None]:
    """Turns what the parser says into errors and warnings of Python."""
    told: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(told.append)
    try:
        yield
    except ValueError as error:
        text = " ".join(str(error).split())
        raise ValueError(f"MuJoCo's parser refuses '{path}': {text}") from None
    finally:
        mujoco.set_mju_user_warning(before)
    for text in told:
        message = f"MuJoCo's parser says of '{path}': {text.strip()}"
        warnings.warn(message, stacklevel=6)


def _resolve_meshes(root: ElementTree.Element, path: Path, ignore: bool) -> None:
    """Writes full paths for meshes, and removes shapes whose mesh cannot be read."""
    options = root.find("mujoco/compiler")
    folder = path.parent / (options.get("meshdir", "") if options is not None else "")
    unread = []
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            mesh = shape.find("geometry/mesh")
            if mesh is None:
                continue
            name = mesh.get("filename", "")
            found = _found(name, path, folder)
            if found is not None and found.suffix.lower() in _MESHES:
                mesh.set("filename", str(found))
            elif ignore:
                link.remove(shape)
            else:
                unread.append(name)
    if unread:
        raise ValueError(
            f"{len(unread)} meshes of '{path}' do not exist or are in another format than "
            f"{', '.join(_MESHES)}, the first of them '{unread[0]}'. To import the file "
            'without these shapes, pass `ignore=("meshes",)`; masses do not depend on them.'
        )


def _found(name: str, path: Path, folder: Path) -> Path | None:
    """The file of a mesh. That of a `package` is looked for in all folders above."""
    scheme, separator, rest = name.partition("://")
    if not separator:
        candidates = [folder / name, folder / Path(name).name]
    elif scheme == "file":
        candidates = [Path(rest)]
    else:
        inside = Path(*Path(rest).parts[1:])
        above = path.resolve().parents
        candidates = [parent / rest for parent in above]
        candidates += [
            parent / inside for parent in above if parent.name == Path(rest).parts[0]
        ]
    return next((x.resolve() for x in candidates if x.is_file()), None)
