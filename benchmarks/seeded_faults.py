"""Which tests notice which faults: one fault at a time, seeded into a copy of the sources.

A suite of tests is as good as the mistakes that it notices. The lists `faults_of_*.py` hold
mistakes that are easy to make and hard to see: most of them keep the energy balance, or
touch one branch, one shape or one lane only. Each is applied to a copy of the project in a
temporary folder; the test files that ought to notice run there, up to the first failure.

    python benchmarks/seeded_faults.py                  # all faults, an hour on a free core
    python benchmarks/seeded_faults.py --only saving    # those whose names begin so
    python benchmarks/seeded_faults.py --all            # all fast tests for survivors
"""

import argparse
import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from faults_of_models import FAULTS as OF_MODELS
from faults_of_runs import FAULTS as OF_RUNS
from faults_of_schemes import FAULTS as OF_SCHEMES
from seeded_fault import Fault


FAULTS: tuple[Fault, ...] = (*OF_SCHEMES, *OF_RUNS, *OF_MODELS)
PROJECT = Path(__file__).parent.parent
# Of the project, what tests read.
_FOLDERS = ("src", "tests", "benchmarks", "docs", "notebooks")
_TEXTS = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "CITATION.cff", "LICENSE")
_NEEDED = (*_FOLDERS, *_TEXTS, "mkdocs.yml", "pyproject.toml")
# The test that faults can be seeded fails wherever one is.
_OF_THE_LIST = "tests/test_conventions.py::test_every_seeded_fault_can_be_seeded"
_PYTEST = ("-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--deselect", _OF_THE_LIST)
# Seconds after which the tests of a fault are given up, and a whole suite.
_LIMIT, _LIMIT_OF_ALL = 180, 3600


@dataclasses.dataclass(frozen=True)
class Finding:
    """What became of a fault.

    - `outcome`: `"caught"`; `"survived"`; `"no verdict"` after too long a time; or `"gone"`
      where the sources no longer hold the text that the fault replaces, just once.
    - `test`: the first test that failed.
    - `seconds`: until then, or until all tests had passed.
    """

    name: str
    file: str
    wrong: str
    outcome: str
    test: str
    seconds: float


def main() -> None:
    options = _options()
    chosen = [x for x in FAULTS if x.name.startswith(tuple(options.only))]
    if not chosen:
        raise SystemExit(f"No fault has a name that begins with {options.only}.")
    names = [x.name for x in FAULTS]
    assert len(set(names)) == len(names), "two faults have one name"
    saved = options.out / "seeded_faults.json"
    old = json.loads(saved.read_text()) if saved.exists() else []
    found = {row["name"]: row for row in old}
    with tempfile.TemporaryDirectory() as folder:
        copy = _copied(Path(folder))
        for fault in chosen:
            finding = tried(fault, copy, everything=options.all)
            print(f"{finding.outcome:10s} {finding.seconds:5.0f} s  {fault.name}", end="  ")
            print(finding.test, flush=True)
            found[fault.name] = dataclasses.asdict(finding)
            rows = [found[name] for name in names if name in found]
            options.out.mkdir(parents=True, exist_ok=True)
            saved.write_text(json.dumps(rows, indent=1) + "\n")
            saved.with_suffix(".md").write_text(table(rows))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", nargs="+", default=[""], help="beginnings of names")
    parser.add_argument("--all", action="store_true", help="the whole suite for survivors")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    return parser.parse_args()


def _copied(folder: Path) -> Path:
    """A copy of the project, from which Python imports the package."""
    copy = folder / "project"
    copy.mkdir()
    ignored = shutil.ignore_patterns("__pycache__", "results")
    for name in _NEEDED:
        source = PROJECT / name
        if source.is_dir():
            shutil.copytree(source, copy / name, ignore=ignored)
        else:
            shutil.copy2(source, copy / name)
    find = [sys.executable, "-c", "import enerjax; print(enerjax.__file__)"]
    out = subprocess.run(
        find,
        cwd=copy,
        env=_environment(copy),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    assert Path(out.stdout.strip()).is_relative_to(copy), "not the copy is imported"
    return copy


def _environment(copy: Path) -> dict[str, str]:
    """Of tests on the copy."""
    return os.environ | dict(PYTHONPATH=str(copy / "src"))


def tried(fault: Fault, copy: Path, *, everything: bool) -> Finding:
    """The fault in the copy, which is as before afterwards."""
    file = copy / "src/enerjax" / fault.file
    text = file.read_text()
    begin = time.monotonic()
    if text.count(fault.old) != 1:
        return _finding(fault, "gone", "", begin)
    file.write_text(text.replace(fault.old, fault.new))
    try:
        outcome, test = _tested(copy, ["-n", "0", "-m", "", *fault.tests], _LIMIT)
        if everything and outcome != "caught":
            outcome, test = _tested(copy, [], _LIMIT_OF_ALL)
    finally:
        file.write_text(text)
    return _finding(fault, outcome, test, begin)


def _finding(fault: Fault, outcome: str, test: str, begin: float) -> Finding:
    seconds = round(time.monotonic() - begin, 1)
    return Finding(fault.name, fault.file, fault.wrong, outcome, test, seconds)


def _tested(copy: Path, arguments: list[str], limit: float) -> tuple[str, str]:
    """The outcome, and the first test that failed."""
    process = subprocess.Popen(
        [sys.executable, *_PYTEST, *arguments],
        cwd=copy,
        env=_environment(copy),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # so that what tests start can be ended with them
    )
    try:
        out, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return "no verdict", ""
    if process.returncode == 0:
        return "survived", ""
    first = re.search(r"^(?:FAILED|ERROR) (?:tests/)?(.+?)(?: - .*)?$", out, re.MULTILINE)
    if first is not None:
        return "caught", first[1]
    if process.returncode < 0:  # XLA can end the whole process
        return "caught", f"the process ended by signal {-process.returncode}"
    raise RuntimeError(f"pytest ended with {process.returncode}:\n{out}")


def table(rows: list[dict]) -> str:
    """In Markdown."""
    caught = sum(row["outcome"] == "caught" for row in rows)
    left = len(FAULTS) - len(rows)
    lines = [
        "# Seeded faults and the tests that notice them",
        "",
        f"{caught} of {len(rows)} are caught by the tests that ought to "
        "(`python benchmarks/seeded_faults.py`)."
        + (f" {left} more are in the lists and have not been tried yet." if left else ""),
        "",
        "| fault | file | what is wrong | outcome | first test that failed | s |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = [row[key] for key in ("name", "file", "wrong", "outcome", "test")]
        cells = [cell.replace("|", "\\|") for cell in [*cells, f"{row['seconds']:.0f}"]]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
