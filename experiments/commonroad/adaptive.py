"""Drive CommonRoad's cars with the shipped policy in path coordinates, as it is and adapting, beside nominal-MPPI.

python -m experiments.commonroad.adaptive [--cars std mb --paths 3 --seconds 60 --seed 2027 --out
experiments/commonroad] Needs the extra `plants`. Nothing is trained. Rows that are in
the file already are not driven again.
"""

import argparse
import json
import sys
import time
from functools import partial
from pathlib import Path

import jax
import numpy as np

import sfkd_jax
from benchmarks.timing.own_model import settings as composed
from experiments.commonroad.train import FRICTIONS, SHIPPED, Driver, make_road
from experiments.commonroad.train import nominal_driver as in_world_frame
from sfkd_jax import adapters, build, evaluation, policy, store

SETTLED = 20
"""Steps at the start of an episode that do not count: 2 s."""


def drivers():
    """Row -> controller, parameters and the number of states that it knows."""
    trained = policy.restore(SHIPPED / "dynamic_path")
    options = dict(trained.settings["controller"], shield=False)
    box = {side: trained.settings["dataset"][f"env_{side}"] for side in ("low", "high")}
    ours, states = trained.vehicle, len(trained.vehicle.state_names)
    build_planner = partial(build.build_controller, plant=ours, law=trained.law)
    nominal = build.reference_systems(ours, trained.law)["nominal"]
    plain = {"env_low": box["low"], "env_high": box["high"]}
    loaded = sfkd_jax.load(
        SHIPPED / "dynamic_path", controller=options | {"adaptive": True}
    )
    rows = {
        "nominal, along the path": (build_planner(options, nominal.model), {}),
        "SFKD": (build_planner(options, trained.model, **plain), trained.params),
        "SFKD, adaptive": (loaded.controller, loaded.params),
    }
    made = {name: Driver(*row, states, {}) for name, row in rows.items()}
    return {"nominal": in_world_frame(composed(), ours, "nominal", states)} | made


def drive(car, driver, track):
    """All roads at once; RMSE in mm before and after half of the time."""
    controller = adapters.commonroad_controller(driver.controller, states=driver.states)

    def one(road, key):
        return evaluation.simulate(
            car.step,
            controller,
            driver.params,
            road,
            key,
            dt=car.dt,
            horizon=20,
            observation_noise=tuple(composed()["evaluation"]["observation_noise"]),
        )

    lateral = np.asarray(jax.jit(jax.vmap(one))(*track).lateral, dtype=np.float64)
    half = lateral.shape[1] // 2
    parts = {"before_mm": lateral[:, SETTLED:half], "after_mm": lateral[:, half:]}
    by_friction = {
        name: (1e3 * np.sqrt(np.mean(part**2, axis=1))).reshape(len(FRICTIONS), -1)
        for name, part in parts.items()
    }
    return {name: part.tolist() for name, part in by_friction.items()}


def main():
    """Parse, drive what is missing, write after every row."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cars", nargs="*", default=["std", "mb"])
    for name, value in (("paths", 3), ("seed", 2027)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--out", type=Path, default=Path("experiments/commonroad"))
    given = parser.parse_args()
    protocol = {name: getattr(given, name) for name in ("paths", "seconds", "seed")}
    protocol["frictions"] = list(FRICTIONS)
    path, document = given.out / "adaptive.json", {"protocol": protocol, "cars": {}}
    if path.exists():
        document = store.read_json(path, keys=("protocol", "cars"))
        if document["protocol"] != protocol:
            raise SystemExit(f"{path}: another protocol; choose another --out")
    for name in given.cars:
        car = adapters.commonroad_vehicle(model=name)
        track = make_road(car, given.paths, given.seconds, given.seed)
        done = document["cars"].setdefault(name, {})
        for row, driver in drivers().items():
            if row in done:
                continue
            began = time.perf_counter()
            done[row] = drive(car, driver, track)
            means = np.mean(done[row]["after_mm"], axis=1).round(1)
            took = time.perf_counter() - began
            print(f"{name}: {row}: {means} mm ({took:.0f} s)", file=sys.stderr)
            document["versions"] = store.versions()
            store.write_json(path, document)
    print(json.dumps({"results": str(path)}))


if __name__ == "__main__":
    main()
