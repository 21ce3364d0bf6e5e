"""How long a control step of every contender of benchmarks.quality.laws takes, in turn in one process, and how long it compiles.

python -m benchmarks.timing.laws [--vehicle kinematic --rounds 15 --out
benchmarks/timing/laws.json]
"""

import time

import jax
import jax.numpy as jnp

import sfkd_jax
from benchmarks import harness
from benchmarks.quality.laws import CONTENDERS, planner_of
from benchmarks.timing import own_model
from sfkd_jax.build import build_vehicle


def step_of(policy, plant, contender):
    """A control step into a bend, and the seconds to trace and compile it."""
    planner = planner_of(policy, plant, *contender)
    seen = own_model.measured(plant, horizon=20)
    given = (policy.params, planner.init(jax.random.key(0)), *seen)
    began = time.perf_counter()
    act = jax.jit(planner.act).lower(*given).compile()
    return lambda: jax.block_until_ready(act(*given)), time.perf_counter() - began


def measured(vehicle, rounds):
    """Label -> times of a step [ms], seconds of the compilation."""
    policy = sfkd_jax.load(harness.SHIPPED / vehicle)
    plant = build_vehicle(policy.settings["vehicle"])
    jnp.zeros(()).block_until_ready()  # the backend starts outside the first time
    built = {
        label: step_of(policy, plant, contender)
        for label, contender in CONTENDERS.items()
    }
    times = harness.in_turn({label: step for label, (step, _) in built.items()}, rounds)
    return {label: row | {"compile_s": built[label][1]} for label, row in times.items()}


def show(row):
    """A row in words."""
    return f"{row['best_ms']:6.2f} ms, compiled in {row['compile_s']:.1f} s"


if __name__ == "__main__":
    harness.of_vehicle(__doc__, measured, show)
