"""`import enerjax` loads only what every program needs."""

import subprocess
import sys


# Each takes as long as the whole of this package, or longer. They are loaded where they
# are used.
HEAVY = {
    "IPython",
    "diffrax",
    "klujax",
    "matplotlib",
    "pandas",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.sparse",
    "scipy.stats",
    "xarray",
}


def test_no_heavy_library_is_imported():
    """Libraries that JAX, equinox and optimistix import themselves do not count."""
    code = (
        "import sys, jax, equinox, optimistix; before = {*sys.modules}; import enerjax; "
        "print(*({*sys.modules} - before))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    loaded = set(run.stdout.split())
    assert "enerjax.schemes" in loaded
    assert loaded & HEAVY == set()
