"""Print docs/results/performance.md with its tables made from the JSON files beside this script; with --write write it.

python -m benchmarks.timing.performance_page [--write] A table stands in the page between <!-- NAME --> and
<!-- end -->; the words around it are written by hand.
"""

import argparse

from benchmarks import harness
from benchmarks.markdown import filled
from benchmarks.timing import tables, targets

PAGE = harness.ROOT / "docs" / "results" / "performance.md"
TABLES = {
    "runs": tables.runs,
    "targets": targets.targets,
    "steps": lambda: tables.steps(False),
    "ratios": tables.ratios,
    "left out": tables.left_out,
    "sweep": tables.sweep,
    "compile": tables.compiling,
    "floor": tables.floor,
    "tails": tables.tails,
    "closed loop": tables.closed_loop,
    "own steps": lambda: tables.steps(True),
    "profile": tables.profile,
    "rows": tables.rows,
}


def built(build):
    """A table, or that there is nothing to make it from yet."""
    try:
        return build()
    except FileNotFoundError as absent:
        return f"Not measured yet: there is no benchmarks/timing/{absent.filename.rsplit('/', 1)[-1]}."


def page():
    """The page with its tables written anew."""
    made = {name: built(build) for name, build in TABLES.items()}
    return filled(PAGE.read_text("utf-8"), made)


def main():
    """Parse, print or write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--write",
        action="store_true",
        help="put the tables into docs/results/performance.md",
    )
    if parser.parse_args().write:
        PAGE.write_text(page(), "utf-8")
    else:
        print(page())


if __name__ == "__main__":
    main()
