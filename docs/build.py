"""Builds the documentation into `site/`.

The notebooks are executed, two at a time, and become Markdown pages in `docs/notebooks/`.
Then all pages are rendered; a broken link or reference is an error.
"""

import re
import shutil
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import nbformat
from latex2mathml.converter import convert
from nbconvert import MarkdownExporter
from nbconvert.preprocessors import ExecutePreprocessor


HOME = Path(__file__).parents[1]
PAGES = HOME / "docs" / "notebooks"
# Code, or a formula on lines of its own, or one within a line.
CODE_OR_FORMULA = re.compile(r"(`+).+?\1|\$\$(.+?)\$\$|\$(.+?)\$", re.DOTALL)


def with_mathml(markdown: str) -> str:
    """The text with its LaTeX formulas as MathML, which browsers draw without a script."""

    def element(found: re.Match[str]) -> str:
        _, block, inline = found.groups()
        if block is None and inline is None:
            return found[0]
        formula = convert(block or inline, display="block" if block else "inline")
        # Markdown looks between the tags for marks of its own, and takes a formula at the
        # start of a line for a paragraph.
        formula = re.sub(r"[*_|\\`\[\]]", lambda mark: f"&#{ord(mark[0])};", formula)
        return formula if block else f"<span>{formula}</span>"

    return CODE_OR_FORMULA.sub(element, markdown)


def make_page(path: Path) -> None:
    """Executes a notebook, and writes it as a page with its pictures."""
    notebook = nbformat.read(path, as_version=4)
    folder = {"metadata": {"path": path.parent}}
    ExecutePreprocessor(timeout=600).preprocess(notebook, folder)
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            cell.source = with_mathml(cell.source)
    names = {"unique_key": path.stem, "output_files_dir": path.stem}
    page, resources = MarkdownExporter().from_notebook_node(notebook, names)
    (PAGES / path.stem).mkdir(parents=True)
    (PAGES / f"{path.stem}.md").write_text(page)
    for name, picture in resources["outputs"].items():
        (PAGES / name).write_bytes(picture)
    print(f"executed {path.name}", flush=True)


def main() -> None:
    shutil.rmtree(PAGES, ignore_errors=True)
    with ProcessPoolExecutor(max_workers=2) as pool:
        list(pool.map(make_page, sorted((HOME / "notebooks").glob("*.ipynb"))))
    build = [sys.executable, "-m", "zensical", "build", "--clean", "--strict"]
    subprocess.run(build, cwd=HOME, check=True)


if __name__ == "__main__":
    main()
