"""How long a control step of every row of sfkd-bench-2 takes, in turn in one process: the time of a structure, whatever its weights.

python -m benchmarks.timing.rows [--vehicle kinematic --rounds 15 --out
benchmarks/timing/rows.json]
"""

from functools import partial

import jax
import jax.numpy as jnp

from benchmarks import harness
from benchmarks.timing import own_model
from sfkd_jax import build
from sfkd_jax.rollout import fold
from sfkd_jax.types import Space

TABLES = ("protocol2", "protocol2_path")
CONTROLS, ENVIRONMENT, PATH_INPUTS = 2, 2, 4


def unit_space(body, controls):
    """Scales of one."""
    sizes = (body, controls, ENVIRONMENT, 3)
    return Space(*(part(size) for size in sizes for part in (jnp.zeros, jnp.ones)))


def box_of(settings):
    """The box of the environment."""
    return {f"env_{side}": settings["environment"][side] for side in ("low", "high")}


def system_of(settings, plant):
    """Model and parameters of a row, and the law of its frame."""
    law = None
    if "law" in settings["dataset"]:
        law = build.build_law(settings["dataset"]["law"], plant, **box_of(settings))
    (name,) = settings["evaluation"]["systems"]
    if name != "self":
        system = build.reference_systems(plant, law)[name]
        return system.model, system.params, law
    body = len(plant.state_names) - 3
    space = unit_space(body, CONTROLS)
    if law is not None:
        space = unit_space(body + 2, PATH_INPUTS)
    model = build.build_model(settings["model"], space, plant)
    params = model.init(jax.random.key(0))
    return model, jax.jit(partial(fold, model))(params), law


def step_of(settings):
    """A control step of a row into a bend."""
    plant = build.build_vehicle(settings["vehicle"])
    model, params, law = system_of(settings, plant)
    box = box_of(settings)
    controller = build.build_controller(
        settings["controller"], model, plant, law=law, **box
    )
    horizon = build.controller_horizon(settings["controller"])
    seen = own_model.measured(plant, horizon)
    act, state = jax.jit(controller.act), controller.init(jax.random.key(0))
    return lambda: jax.block_until_ready(act(params, state, *seen))


def steps(vehicle):
    """Row -> its control step."""
    jobs = {}
    for table in TABLES:
        common = (f"+experiment={table}", f"vehicle={vehicle}")
        comparison = own_model.settings(*common)["comparison"]
        for label, row in comparison["rows"].items():
            name = next(iter(comparison["controllers"]))
            name = comparison["own_controllers"].get(label, {}).get(name, name)
            settings = own_model.settings(*common, f"controller={name}", *row.split())
            title = f"{label}, path" if label in jobs else label
            jobs[title] = step_of(settings)
    return jobs


def measured(vehicle, rounds):
    """Row -> times of a step [ms]."""
    return harness.in_turn(steps(vehicle), rounds)


def show(row):
    """A row in words."""
    return f"{row['best_ms']:6.2f} ms, median {row['median_ms']:6.2f} ms"


if __name__ == "__main__":
    harness.of_vehicle(__doc__, measured, show)
