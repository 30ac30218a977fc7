"""The code in the documentation runs, links lead somewhere, and lists are complete."""

import importlib.util
import operator
import pathlib
import re

import matplotlib.pyplot as plt
import pytest

import enerjax as ej

from .helpers import code_blocks, long, public_names


HOME = pathlib.Path(__file__).parents[1]
DOCS = HOME / "docs"
API = sorted((DOCS / "api").glob("*.md"))
PAGES = [HOME / "README.md", *sorted(DOCS.glob("*.md")), *API]
NAVIGATION = re.findall(r"([\w/-]+\.md)$", (HOME / "mkdocs.yml").read_text(), re.MULTILINE)


def is_missing(mark):
    """Whether a block with the mark `needs NAME ...` needs a package that is missing."""
    return not all(map(importlib.util.find_spec, mark.split()[1:]))


def runs(mark):
    """`no-run` marks what compiles for most of a minute and is run by other tests."""
    return mark != "no-run" and not is_missing(mark)


def with_code():
    """Pages whose packages are all there; `.ci/extras` runs those that need others."""
    marks = {page: [mark for mark, _ in code_blocks(page)] for page in PAGES}
    missing = {page for page in PAGES if any(map(is_missing, marks[page]))}
    pages = [page for page in PAGES if page not in missing and any(map(runs, marks[page]))]
    # Other tests run the scheme of one of these pages, and beams.
    others = ("beams.md", "write-your-own-scheme.md")
    return long(pages, *(x for x in pages if x.name in others))


@pytest.mark.parametrize("page", with_code(), ids=lambda page: page.name)
@pytest.mark.slow_for(
    "events.md", "pictures.md", "rolling.md", "identification.md", "schemes.md"
)
def test_the_code_of_a_page_runs(page, tmp_path, monkeypatch):
    """A page is read from top to bottom: later blocks use names of earlier ones."""
    monkeypatch.chdir(tmp_path)
    names = {}
    for mark, code in code_blocks(page):
        if runs(mark):
            exec(compile(code, str(page), "exec"), names)
    plt.close("all")
    if page.name == "pictures.md":
        shown = re.findall(r"\]\(pictures/([^)]+)\)", page.read_text())
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted(shown)


def test_every_mark_is_known():
    marks = {mark for page in PAGES for mark, _ in code_blocks(page)}
    optional = ["mujoco", "pandas", "viser", "xarray"]
    for mark in marks - {"", "no-run"}:
        needs, *names = mark.split()
        assert needs == "needs"
        assert {*names} <= {*optional}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_code_that_is_not_run_is_valid(page):
    for mark, code in code_blocks(page):
        if not runs(mark):
            compile(code, str(page), "exec")


def test_the_navigation_has_every_page_once():
    """A page that `nav` in `mkdocs.yml` lacks could not be found by readers."""
    pages = [str(page.relative_to(DOCS)) for page in PAGES[1:]]
    pages += [f"notebooks/{path.stem}.md" for path in (HOME / "notebooks").glob("*.ipynb")]
    assert len(pages) > 20
    assert sorted(NAVIGATION) == sorted(pages)


@pytest.mark.parametrize(
    "page", [*PAGES, HOME / "CONTRIBUTING.md", HOME / "CHANGELOG.md"], ids=lambda x: x.name
)
def test_links_and_pictures_are_files(page):
    """The build of the site checks the anchors of links, and not the pictures."""
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text()):
        made = re.fullmatch(r"(?:\.\./)?(notebooks/\w+)\.md", target)
        file = HOME / f"{made[1]}.ipynb" if made else page.parent / target
        assert file.exists(), target
        shown = DOCS if page.is_relative_to(DOCS) else HOME
        assert file.resolve().is_relative_to(HOME if made else shown), "not in the site"


def test_the_api_pages_list_every_public_name():
    """A new public name needs a line `::: NAME` on the page in `docs/api` that it suits."""
    text = "\n".join(page.read_text() for page in API)
    names = re.findall(r"^(?:::: |\| `)(enerjax\.[\w.]+)", text, re.MULTILINE)
    listed = [operator.attrgetter(name.partition(".")[2])(ej) for name in names]
    assert len({id(value) for value in listed}) == len(listed)
    shown = {id(value) for value in listed}
    assert [name for name, value in public_names().items() if id(value) not in shown] == []


def test_the_table_of_subpackages_is_complete():
    text = (DOCS / "how-it-works.md").read_text()
    package = pathlib.Path(ej.__file__).parent
    names = [path.parent.name for path in package.glob("*/__init__.py")]
    assert len(names) > 5
    assert [name for name in names if f"| `{name}` |" not in text] == []
