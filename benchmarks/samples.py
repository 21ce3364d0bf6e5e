"""How much a fifth of the samples costs: the shipped path policies with 1500 and with 300.

python -m benchmarks.samples    writes benchmarks/samples.json
Both drive the same roads with the same noise, inside their shield. The roads are those of
no other choice (seed 2031).
"""

from itertools import product

import jax
import numpy as np

from benchmarks import arguments, device, write


def main():
    """Drive and write."""
    protocol = {"episodes": 8, "seconds": 30.0, "seed": 2031}
    given = arguments(__doc__, __file__, **protocol)
    head = {key: getattr(given, key) for key in protocol}
    keys, rows = jax.random.split(jax.random.key(given.seed), given.episodes), []
    for name, scenario, samples in product(
        device.CARS[::-1], ("s2", "s3"), (1500, 300)
    ):
        policy = device.loaded(name, samples)
        drive = device.fresh_episodes(policy, scenario, given.seconds)
        rmse = device.rmse_mm(drive(keys)[:, device.SETTLED :])
        row = {"policy": f"{name}_path", "scenario": scenario, "samples": samples}
        rows.append(row | {"rmse_mm": np.round(rmse, 3).tolist()})
        print(row, round(float(np.mean(rmse)), 2), flush=True)
        write(given.out, head, rows)


if __name__ == "__main__":
    main()
