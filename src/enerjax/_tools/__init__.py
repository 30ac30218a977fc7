"""Tools that make many runs: sweeps, fits, comparisons of schemes, reports."""
