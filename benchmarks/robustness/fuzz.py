"""Read 10^5 damaged files and count misreadings, hangs, memory and unnamed refusals.

    python -m benchmarks.robustness.fuzz [--cases 100000 --seed 1]
        [--out benchmarks/robustness/fuzz.json]

The engine is tests/fuzzing.py, of which the tests run 10^4 cases with another seed. It
runs in a process of its own, whose address space may grow by 1 GiB; a case has 30 s.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from benchmarks import harness

ENGINE = Path(__file__).parents[2] / "tests" / "fuzzing.py"


def main():
    """Run the engine, and write its counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in (("cases", 100_000), ("seed", 1)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--out")
    options = parser.parse_args()
    settings = ["--cases", str(options.cases), "--seed", str(options.seed)]
    command = [sys.executable, str(ENGINE), *settings]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if not done.stdout:
        sys.exit(f"the engine died with exit status {done.returncode}")
    words = [*settings, "--out", "benchmarks/robustness/fuzz.json"]
    document = json.loads(done.stdout) | {
        "command": f"python -m benchmarks.robustness.fuzz {' '.join(words)}",
        "machine": harness.machine(),
    }
    harness.write(options.out, document)
    sys.exit(done.returncode)


if __name__ == "__main__":
    main()
