"""Tables of text."""

from collections.abc import Sequence


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells, the first a header, in columns of equal width."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    line = lambda cells: "  ".join(
        cell.ljust(width) for cell, width in zip(cells, widths, strict=True)
    ).rstrip()
    header, *body = rows
    return "\n".join([line(header), line(["-" * w for w in widths]), *map(line, body)])


def with_uncertainty(rows: Sequence[Sequence[str]], uncertainty: dict[str, float]) -> str:
    """A table of errors, and how well their reference is known."""
    known = ", ".join(f"{name} {number(u)}" for name, u in uncertainty.items())
    return f"{aligned(rows)}\nuncertainty of the reference: {known}"


def number(x: float) -> str:
    """An error in two digits; nothing where it is not known."""
    return "" if x != x else f"{x:.1e}"
