from .dense import (
    AbstractFactors as AbstractFactors,
    empty_factors as empty_factors,
    inverse as inverse,
    solve as solve,
)
from .dots import plain_products as plain_products
from .symmetric import cholesky as cholesky, eigh as eigh
