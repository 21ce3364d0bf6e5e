"""Search for a false claim that the trusted core accepts, with exact arithmetic.

    python -m benchmarks.trusted_core [--cases 200000 --seed 1]

Half of the cases are hostile matrices with a tolerated error, half are networks with
multipliers, a bound, A and P. The search stops at the first case that is accepted and
false. `true` counts the cases that hold, `accepted` those that the core accepts.
"""

import json
import sys
import time
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from exact import search  # The tests run the same search with fewer cases.

from benchmarks import arguments
from sfkd_jax import store

if __name__ == "__main__":
    given = arguments(__doc__, __file__, cases=200_000, seed=1)
    began, about = time.perf_counter(), {"cases": given.cases, "seed": given.seed}
    counts = {"false_and_accepted": 0, **search(given.cases, given.seed)}
    spent = {"seconds": round(time.perf_counter() - began)}
    document = about | counts | spent | {"versions": store.versions()}
    store.write_json(given.out, document)
    print(json.dumps(document))
