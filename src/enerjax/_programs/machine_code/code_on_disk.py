"""Programs and their machine code on disk, for other processes.

They are kept in the folder in which JAX keeps what XLA has compiled, if it is asked to
(`jax_compilation_cache_dir`). Every file is that of one program or text, one machine, and
one version of all that takes part, and is found by a checksum of these.
"""

import functools
import hashlib
import importlib.metadata
import os
import tempfile
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from ..digest import checksum, complete_digest
from .compiler import machine, object_of


class Code(NamedTuple):
    """A program as text.

    - `length`: the number of its operations.
    - `texts`: its modules; see `handler.py`.
    - `constants`, `tables`: the arrays to which these refer.
    """

    length: int
    texts: list[str]
    constants: np.ndarray
    tables: list[np.ndarray]


def key_of(jaxpr: Any, known: Sequence[np.ndarray | None]) -> str | None:
    """The key of a program with some known inputs.

    `None` if no programs are kept, or if it has a part that cannot be compared.
    """
    if _folder() is None:
        return None
    word = complete_digest(ClosedJaxpr(jaxpr, ()))
    if word is None:
        return None
    arrays = ["" if x is None else checksum([x]) for x in known]
    return _word(word, _versions(), machine(), *arrays)


def is_worth_keeping(seconds: float) -> bool:
    """Whether a program whose text was found in so many seconds is kept.

    To compile the text takes about as long. JAX is asked for the least sum.
    """
    return 2 * seconds >= _config().jax_persistent_cache_min_compile_time_secs


def kept_code(key: str) -> Code | None:
    found = _read(f"{key}.npz")
    if found is None:
        return None
    counts = found["counts"].tolist()
    texts = [
        zlib.decompress(found[f"text{k}"].tobytes()).decode() for k in range(counts[1])
    ]
    tables = [found[f"table{k}"] for k in range(counts[2])]
    return Code(counts[0], texts, found["constants"], tables)


def keep_code(key: str, code: Code) -> None:
    texts = (zlib.compress(x.encode(), 1) for x in code.texts)
    arrays = {f"text{k}": np.frombuffer(x, np.uint8) for k, x in enumerate(texts)}
    arrays |= {f"table{k}": x for k, x in enumerate(code.tables)}
    counts = np.array([code.length, len(code.texts), len(code.tables)])
    _write(f"{key}.npz", counts=counts, constants=code.constants, **arrays)


def kept_object(text: str) -> bytes:
    """The machine code of a module, from disk, or compiled and kept there."""
    name = f"{_word(text, machine())}.npz"
    found = _read(name)
    if found is not None:
        return found["code"].tobytes()
    code = object_of(text)
    _write(name, code=np.frombuffer(code, np.uint8))
    return code


# Files ------------------------------------------------------------------------------------


def _config() -> Any:
    # The type of `jax.config` does not name its options.
    return jax.config


def _folder() -> Path | None:
    """The folder, if there is one on this computer."""
    config = _config()
    name = config.jax_compilation_cache_dir
    if not name or not config.jax_enable_compilation_cache or "://" in str(name):
        return None
    return Path(name) / "enerjax"


def _read(name: str) -> dict[str, np.ndarray] | None:
    """The arrays of a file, if there is one, and if it is whole."""
    folder = _folder()
    if folder is None:
        return None
    try:
        with np.load(folder / name, allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        return None


def _write(name: str, **arrays: np.ndarray) -> None:
    """Writes a file in one piece."""
    folder = _folder()
    if folder is None:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Other processes may write the same file.
        with tempfile.TemporaryDirectory(dir=folder) as own:
            np.savez(Path(own) / name, **arrays)  # pyright: ignore[reportArgumentType]
            os.replace(Path(own) / name, folder / name)
    except OSError as error:
        warnings.warn(
            f"Machine code cannot be kept in {folder} ({error}). The next process compiles "
            "it again. Choose another folder by `jax_compilation_cache_dir`.",
            stacklevel=2,
        )


def _word(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


@functools.cache
def _versions() -> str:
    """One word for the source of programs, and for the packages that it uses."""
    source = Path(__file__).parents[1]
    files = sorted(source.rglob("*.py"))
    packages = "jax", "jaxlib", "numpy", "llvmlite"
    return _word(
        *(importlib.metadata.version(x) for x in packages),
        *(x.read_text(encoding="utf-8") for x in files),
    )
