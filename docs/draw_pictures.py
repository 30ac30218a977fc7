"""Draws the pictures of the page on pictures into `docs/pictures/`, by running its code."""

import os
import re
from pathlib import Path

import matplotlib


PAGE = Path(__file__).parent / "pictures.md"


def draw(folder: Path) -> None:
    """Runs the code of the page, which saves its pictures in the current folder."""
    os.chdir(folder)
    names: dict[str, object] = {}
    for code in re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.M | re.S):
        exec(compile(code, str(PAGE), "exec"), names)


if __name__ == "__main__":
    matplotlib.use("agg")
    draw(PAGE.with_suffix(""))
