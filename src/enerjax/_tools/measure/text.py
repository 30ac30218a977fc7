"""Tables of text."""

from collections.abc import Sequence


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells, of which the first is a header, in aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    line = lambda cells: "  ".join(
        cell.ljust(width) for cell, width in zip(cells, widths, strict=True)
    ).rstrip()
    header, *body = rows
    return "\n".join([line(header), line(["-" * w for w in widths]), *map(line, body)])


def with_uncertainty(rows: Sequence[Sequence[str]], uncertainty: dict[str, float]) -> str:
    """A table of errors, followed by the uncertainty of the reference."""
    known = ", ".join(f"{name} {number(u)}" for name, u in uncertainty.items())
    return f"{aligned(rows)}\nuncertainty of the reference: {known}"


def number(x: float) -> str:
    """An error with two digits; empty if it is not known."""
    return "" if x != x else f"{x:.1e}"
