"""Checksums of arrays: of results on disk, and of what a sweep is told by."""

import hashlib
from collections.abc import Iterable
from typing import Any

import numpy as np


def add_array(word: Any, array: Any) -> None:
    """Adds shape, dtype and content of an array to a hash of `hashlib`."""
    array = np.ascontiguousarray(array)
    word.update(repr((array.shape, str(array.dtype))).encode())
    word.update(array.tobytes())


def checksum(arrays: Iterable[Any]) -> str:
    """One word for some arrays."""
    word = hashlib.sha256()
    for array in arrays:
        add_array(word, array)
    return word.hexdigest()
