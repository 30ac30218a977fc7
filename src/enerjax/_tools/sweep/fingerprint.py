"""Fingerprints of sweeps, by which a folder of results is recognised."""

import hashlib
from typing import Any

import jax
import numpy as np

from ..._programs import checksum, digest
from .grid import Grid


def fingerprint(grid: Grid, chunks: np.ndarray, traced: Any) -> dict[str, str]:
    """One word for each property of a sweep that must not change when it is resumed."""
    word = hashlib.sha256(repr((grid.axes, grid.shape)).encode())
    for name, values in grid.values.items():
        word.update(repr((name, str(jax.tree.structure(values)))).encode())
        word.update(checksum(jax.tree.leaves(values)).encode())
    return {
        "parameters": word.hexdigest(),
        "chunks": checksum([chunks.astype(np.int64)]),
        "results": str(jax.tree.structure(traced.out_info)),
        "program": digest(traced.jaxpr),
    }
