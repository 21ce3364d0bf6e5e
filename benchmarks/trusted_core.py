"""Search for a false claim that the trusted core accepts, with exact arithmetic.

    python -m benchmarks.trusted_core [--cases 200000 --seed 1]
        [--out benchmarks.trusted_core.json]

Half of the cases are hostile matrices with a tolerated error, half are networks with
multipliers, a bound, A and P. The search stops at the first case that is accepted and
false. `true` counts the cases that hold, `accepted` those that the core accepts.
"""

import argparse
import json
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parent / "tests"))

from exact import search  # noqa: E402  the tests run the same search with fewer cases

from sfkd_jax import store  # noqa: E402


def main():
    """Search, and write the counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    began = time.perf_counter()
    counts = search(options.cases, options.seed)
    document = {
        "cases": options.cases,
        "seed": options.seed,
        "false_and_accepted": 0,
        **counts,
        "seconds": round(time.perf_counter() - began),
        "versions": store.versions(),
    }
    if options.out:
        store.write_json(options.out, document)
    print(json.dumps(document))


if __name__ == "__main__":
    main()
