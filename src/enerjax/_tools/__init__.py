"""What is done with many runs: sweeps, fits, orders, work and precision, reports."""
