"""Search for a falsehood that the trusted core accepts: hostile matrices and witnesses against exact arithmetic.

python -m benchmarks.robustness.trusted_core [--cases 200000 --seed 1 --out
benchmarks/robustness/trusted_core.json] Every second case is a matrix with a tolerated error,
every other one a network with multipliers, a bound, A and P. It stops at the first case
that is accepted and false. `true` counts those that hold, `accepted` those that passed.
"""

import argparse
import json
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parents[1] / "tests"))

from exact import search  # noqa: E402  beside the tests, which run the same search shorter

from sfkd_jax import artefacts  # noqa: E402


def main():
    """Search and write what was counted."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    began = time.perf_counter()
    counts = search(asked.cases, asked.seed)
    document = {
        "cases": asked.cases,
        "seed": asked.seed,
        "false_and_accepted": 0,
        **counts,
    }
    document |= {
        "seconds": round(time.perf_counter() - began),
        "versions": artefacts.versions(),
    }
    if asked.out:
        artefacts.write_json(asked.out, document)
    print(json.dumps(document))


if __name__ == "__main__":
    main()
