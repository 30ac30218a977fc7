"""Draws the pictures of the viewer: runs the code of the pages, and opens what it saves.

    python docs/screenshots.py

Needs chromium, and the extras `view` and `import`. The pictures are
`docs/pictures/NAME-viewer.png`.
"""

import contextlib
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image


HOME = Path(__file__).parents[1]
sys.path.insert(0, str(HOME))

from tests.browser import open_page  # noqa: E402
from tests.helpers import code_blocks  # noqa: E402


# A page of the documentation, a file that its code saves, and the part of the film that is
# shown.
SHOWN = [
    ("viewer.md", "four-bar.html", 0.3),
    ("viewer.md", "gyroscope.html", 0.4),
    ("import.md", "arm.html", 0.25),
]
SIZE, COLORS = (720, 480), 96


def main() -> None:
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for page in sorted({page for page, _, _ in SHOWN}):
            names = {}
            for mark, code in code_blocks(HOME / "docs" / page):
                if mark != "no-run":
                    exec(compile(code, page, "exec"), names)
        for _, name, part in SHOWN:
            path = HOME / "docs" / "pictures" / f"{Path(name).stem}-viewer.png"
            shoot(Path(name).absolute(), Path(folder) / f"browser of {name}", part, path)


def shoot(file: Path, folder: Path, part: float, picture: Path) -> None:
    """Stops the film of a file at a part of its time, and writes what is seen."""
    with open_page(file, folder, SIZE) as page:
        page.wait_for("document.querySelector('.mantine-Slider-root') && true")
        page.wait_for("document.querySelector('canvas') && true")
        page.evaluate(
            "document.querySelector('.mantine-Notification-closeButton')?.click()"
        )
        page.press_space()
        page.settled()
        x, y, long, thick = page.evaluate(
            "(() => {const r = document.querySelector('.mantine-Slider-root')"
            ".getBoundingClientRect(); return [r.x, r.y, r.width, r.height]})()"
        )
        page.press(x + part * long, y + thick / 2)
        seen = page.settled().astype(np.uint8)
    Image.fromarray(seen).quantize(COLORS).save(picture, optimize=True)


if __name__ == "__main__":
    main()
