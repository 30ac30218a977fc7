"""Factorisations and Jacobians: small and dense, banded, in blocks, by a given solver."""
