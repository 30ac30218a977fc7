"""The code in the documentation runs, and its tables of the package are complete."""

import pathlib

import matplotlib.pyplot as plt
import pytest

import enerjax as ej

from .helpers import code_blocks, long


HOME = pathlib.Path(__file__).parents[1]
PAGES = [HOME / "README.md", *sorted((HOME / "docs").glob("*.md"))]


# Blocks that are marked with `no-run` need an optional extra, or compile for most of a
# minute what other tests run already.
def with_code():
    pages = [page for page in PAGES if any(not mark for mark, _ in code_blocks(page))]
    # The scheme of this page is a file of the tests, which others run.
    return long(pages, *(x for x in pages if x.name == "write-your-own-scheme.md"))


@pytest.mark.parametrize("page", with_code(), ids=lambda page: page.name)
def test_the_code_of_a_page_runs(page, tmp_path, monkeypatch):
    """A page is read from top to bottom: later blocks use names of earlier ones."""
    monkeypatch.chdir(tmp_path)
    # This process has started its CPU back end, which reads its settings only once.
    monkeypatch.setattr(ej, "enable_fast_loops", lambda: None)
    names = {}
    for mark, code in code_blocks(page):
        if not mark:
            exec(compile(code, str(page), "exec"), names)
    plt.close("all")


def test_every_mark_is_known():
    assert {mark for page in PAGES for mark, _ in code_blocks(page)} <= {"", "no-run"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_code_that_is_not_run_is_valid(page):
    for mark, code in code_blocks(page):
        if mark:
            compile(code, str(page), "exec")


def test_the_readme_links_to_every_page():
    text = PAGES[0].read_text()
    assert [page.name for page in PAGES[1:] if f"(docs/{page.name})" not in text] == []


def test_the_table_of_subpackages_is_complete():
    text = (HOME / "docs" / "how-it-works.md").read_text()
    package = pathlib.Path(ej.__file__).parent
    names = [path.parent.name for path in package.glob("*/__init__.py")]
    assert len(names) > 5
    assert [name for name in names if f"| `{name}` |" not in text] == []
