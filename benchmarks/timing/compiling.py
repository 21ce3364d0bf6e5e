"""What compiling `act` costs in a fresh process, without and with jax's persistent compilation cache; prints JSON.

python -m benchmarks.timing.compiling [--rounds 3]; problems: the shared one, and the project's
own model (own_model.py).
"""

import argparse
import json
import statistics
import tempfile
import time

from benchmarks import harness
from benchmarks.timing import ours, own_model

SAMPLES, HORIZON = 1500, 20


def build(name):
    """A controller and what its `act` takes."""
    if name == "own model":
        return own_model.problem(SAMPLES, HORIZON)
    controller, w = ours.planner(SAMPLES, HORIZON)
    return controller, ours.arguments(controller, w, HORIZON)


def measure(name):
    """Seconds to trace, to compile and to the first control, in this process."""
    import jax

    controller, given = build(name)
    began = time.perf_counter()
    lowered = jax.jit(controller.act).lower(*given)
    traced = time.perf_counter()
    compiled = lowered.compile()
    ready = time.perf_counter()
    jax.block_until_ready(compiled(*given))
    done = time.perf_counter()
    return {
        "trace_s": traced - began,
        "compile_s": ready - traced,
        "first_step_s": done - ready,
    }


def kept_in(directory):
    """Environment variables for a persistent cache that keeps whatever is compiled."""
    keep = {"MIN_COMPILE_TIME_SECS": "0", "MIN_ENTRY_SIZE_BYTES": "-1"}
    names = {f"JAX_PERSISTENT_CACHE_{name}": value for name, value in keep.items()}
    return names | {"JAX_COMPILATION_CACHE_DIR": directory}


def rounds(name, count):
    """Medians without a cache and with a full one."""
    with tempfile.TemporaryDirectory() as directory:
        cached = kept_in(directory)
        ask = lambda environment: harness.in_own_process(
            "benchmarks.timing.compiling", "--measure", name, environment=environment
        )
        ask(cached)
        both = [(ask({}), ask(cached)) for _ in range(count)]
    middle = lambda runs: {
        key: statistics.median(run[key] for run in runs) for key in runs[0]
    }
    return {
        "cold": middle([cold for cold, _ in both]),
        "warm": middle([warm for _, warm in both]),
    }


def main():
    """Parse, run, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    names = ("shared problem", "own model")
    parser.add_argument("--measure", choices=names, help=argparse.SUPPRESS)
    args = parser.parse_args()
    result = (
        measure(args.measure)
        if args.measure
        else {name: rounds(name, args.rounds) for name in names}
    )
    print(json.dumps(result))


if __name__ == "__main__":
    main()
