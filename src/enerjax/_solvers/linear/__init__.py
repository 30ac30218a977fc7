"""Jacobians and factorisations: dense, banded, block-diagonal, or by a user's solver."""
