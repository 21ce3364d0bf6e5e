"""How much a fifth of the samples costs: the shipped path policies with 1500 and with 300.

python -m benchmarks.samples    writes benchmarks/samples.json
Both drive the same roads with the same noise, inside their shield. The roads are those of
no other choice (seed 2031).
"""

import argparse
import json
from functools import partial
from pathlib import Path

import jax
import numpy as np

from benchmarks import device
from sfkd_jax import evaluation, scenarios

SETTLED = 20
"""Steps at the start of an episode that do not count: 2 s."""


def rmse(name, samples, scenario, count, seconds, seed):
    """Lateral RMSE of every episode [mm]."""
    trained, policy = device.loaded(name, samples)
    plant = trained.vehicle
    family = scenarios.scenario(
        name=scenario,
        duration=seconds,
        state_size=len(plant.state_names),
        dt=plant.dt,
    )
    run = partial(
        evaluation.simulate,
        plant.step,
        policy.controller,
        policy.params,
        dt=plant.dt,
        horizon=device.HORIZON,
        observation_noise=(0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001),
    )

    def one(key):
        road_key, run_key = jax.random.split(key)
        return run(scenario=family(road_key), key=run_key).lateral

    keys = jax.random.split(jax.random.key(seed), count)
    lateral = np.asarray(jax.jit(jax.vmap(one))(keys), dtype=np.float64)
    return 1e3 * np.sqrt(np.mean(lateral[:, SETTLED:] ** 2, axis=1))


def main():
    """Drive and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=2031)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/samples.json"))
    given = parser.parse_args()
    about = {key: getattr(given, key) for key in ("episodes", "seconds", "seed")}
    rows = []
    for name in ("kinematic_path", "dynamic_path"):
        for scenario in ("s2", "s3"):
            for samples in (1500, 300):
                errors = rmse(name, samples, scenario, *about.values())
                row = {"policy": name, "scenario": scenario, "samples": samples}
                rows.append(row | {"rmse_mm": np.round(errors, 3).tolist()})
                print(json.dumps(row), round(float(np.mean(errors)), 2), flush=True)
                lines = ",\n".join(f"  {json.dumps(one)}" for one in rows)
                head = json.dumps(about)[:-1]
                given.out.write_text(f'{head}, "rows": [\n{lines}\n]}}\n', "utf-8")


if __name__ == "__main__":
    main()
