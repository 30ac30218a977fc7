"""The main job: all schemes on the four test cases of E. Lens and A. Cardona.

    python -m enerjax [--out FOLDER] [--quick]

It prints a table, writes it as CSV, and draws the counterparts of the paper's figures.
"""

import argparse
import sys
import time
from pathlib import Path

import jax


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m enerjax",
        description="Run the four test cases of E. Lens and A. Cardona with all schemes, "
        "print one table, and write it and the counterparts of the paper's figures.",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("enerjax-report"),
        metavar="FOLDER",
        help="where to write table.csv and figure-NN.png (default: enerjax-report)",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="a tenth of the steps, and no compositions above order 4",
    )
    options = parser.parse_args(arguments)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        probe = options.out / "table.csv"
        probe.touch()
    except OSError as error:
        parser.error(f"cannot write to --out {options.out}: {error.strerror}")
    return options


def _progress(message: str) -> None:
    if sys.stderr.isatty():
        print(f"\r\x1b[K{message}", end="", file=sys.stderr, flush=True)
    else:
        print(message, file=sys.stderr, flush=True)


def main(arguments: list[str] | None = None) -> None:
    begin = time.perf_counter()
    options = _parse(arguments)
    jax.config.update("jax_enable_x64", True)
    # Imported after the options have been checked, because this import is slow.
    from ._tools.report import figures, runs, table

    done = runs.run_all(options.quick, _progress)
    table.write_csv(done, options.out / "table.csv")
    _progress("drawing")
    pictures = figures.write_figures(runs.curves(done), options.out)
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr)
    print(table.as_text(done))
    seconds = time.perf_counter() - begin
    print(
        f"\n{len(done)} runs in {seconds:.0f} s on {jax.devices()[0].device_kind}, "
        f"compilation included. Wrote table.csv and {len(pictures)} figures to "
        f"{options.out}/"
    )


if __name__ == "__main__":
    main()
