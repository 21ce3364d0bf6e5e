"""Change files 10^5 times and read them: what was misread, hung, took memory or was refused without a name.

python -m benchmarks.robustness.fuzz [--cases 100000 --seed 1 --out benchmarks/robustness/fuzz.json] The
engine is tests/fuzzing.py, of which the tests run 10^4 cases with another seed. It runs
in a process of its own, whose address space may grow by 1 GiB, and each case has 30 s.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from benchmarks import harness

ENGINE = Path(__file__).parents[2] / "tests" / "fuzzing.py"


def main():
    """Run the engine, print and write what it found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in (("cases", 100_000), ("seed", 1)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--out")
    asked = parser.parse_args()
    words = [
        sys.executable,
        str(ENGINE),
        "--cases",
        str(asked.cases),
        "--seed",
        str(asked.seed),
    ]
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True)
    if not done.stdout:
        sys.exit(f"the engine died with exit status {done.returncode}")
    command = f"python -m benchmarks.robustness.fuzz --cases {asked.cases} --seed {asked.seed} --out benchmarks/robustness/fuzz.json"
    harness.write(
        asked.out,
        json.loads(done.stdout) | {"command": command, "machine": harness.machine()},
    )
    sys.exit(done.returncode)


if __name__ == "__main__":
    main()
