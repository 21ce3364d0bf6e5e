"""How near errors come to the bound R_k, and whether it shows when a rate, d̄ or a model is not what is claimed.

python -m benchmarks.quality.theorem_power [--segments 400 --out benchmarks/quality/theorem_power.json]
Shipped policies on drives that neither training nor calibration saw: S1 and S2, and
S3's switching. V0 counts steps at which |e_k| > R_k though every |d_j| ≤ d̄; reach is
the largest |e_k| / R_k there, which the theorem keeps below 1. Beside it: the share of
single steps whose error leaves each measured bound while a side force that nobody
measures pushes the car, constant over the step and drawn from [-F, F].
"""

import argparse
import json
from functools import partial
from pathlib import Path

import jax
import numpy as np

from sfkd_jax import build, demo, evaluation, policy, store
from sfkd_jax import data as datasets
from sfkd_jax.certification import latent_tube
from sfkd_jax.evaluation import predictions, theorem_reach, theorem_violations
from sfkd_jax.rollout import fold, step_disturbances

HORIZON, SEED = 20, 12345
FORGED_ALPHA, FORGED_D_BAR = (0.98, 0.95, 0.9, 0.5), (0.5, 0.25)
FORCES = (0, 250, 500, 1000)
KINDS = ("latent", "position", "yaw", "body")
SHORTER = (1.02, 1.1, 1.3)
"""Factors of A(e): a model that does not contract as its certificate says."""


def driven(trained, segments):
    """Drives by scenario."""
    args = trained.settings["dataset"] | {"segments": segments}
    options = build.as_kwargs(args, "shares", "env_low", "env_high", "seed")
    steady, switching = jax.random.split(jax.random.key(SEED))
    driver = build.build_driver(trained.vehicle)
    switches = {
        name: value for name, value in options.items() if name != "fixed_levels"
    }
    return {
        "s1, s2": jax.jit(
            partial(datasets.generate, trained.vehicle, driver, **options)
        )(steady),
        "s3": jax.jit(
            partial(datasets.generate_switching, trained.vehicle, driver, **switches)
        )(switching),
    }


def measured(result, alpha, d_bar):
    """V0 and reach under these claims."""
    tube = latent_tube(alpha, d_bar, HORIZON)
    broken, applied = theorem_violations(
        result.latent_errors, result.defects, tube, d_bar
    )
    reach = [
        share
        for share in theorem_reach(result.latent_errors, result.defects, tube, d_bar)
        if share is not None
    ]
    where = {
        f"reach_{step}": round(reach[step - 1], 3) if len(reach) >= step else None
        for step in (1, 5, 20)
    }
    return {
        "broken": broken,
        "applied": applied,
        "reach": round(max(reach), 3) if reach else None,
        **where,
    }


def disturbed(trained, params, drives, bounds, force):
    """Share of steps that leave the bound of each kind when the step itself is pushed
    sideways.
    """
    plant, model = trained.vehicle, trained.model

    def one(key, before, control, env):
        actual = (
            evaluation.disturbed_environment(plant, env[None], key, largest=force)[0]
            if force
            else env
        )
        fiber = model.fiber(params, env)
        origin = model.encode(fiber, before)
        return step_disturbances(
            model,
            fiber,
            fiber,
            origin,
            before,
            control,
            plant.step(before, control, actual),
        )

    steps = drives.controls.shape[1]
    keys = jax.random.split(jax.random.key(SEED + 1), (drives.controls.shape[0], steps))
    result = jax.jit(jax.vmap(jax.vmap(one)))(
        keys, drives.states[:, :-1], drives.controls, drives.envs
    )
    return {
        kind: round(float(np.mean(np.asarray(result[..., k]) > bounds[kind])), 4)
        for k, kind in enumerate(KINDS)
    }


def lengthened(params, factor):
    """Folded parameters with every A_j multiplied."""
    shared = params.shared
    return params._replace(shared=shared._replace(vertices=factor * shared.vertices))


def rows(plant, segments):
    """Claims as they are, and forged."""
    trained = policy.restore(demo.SHIPPED / plant)
    certificate, _ = policy.read_certificate(demo.SHIPPED / plant, trained)
    alpha, d_bar = certificate["alpha"], certificate["d_bar"]["value"]
    params = jax.jit(partial(fold, trained.model))(trained.params)
    length = trained.settings["dataset"]["steps"]
    predict = jax.jit(
        partial(predictions, trained.model, length=length, horizon=HORIZON)
    )
    for scenario, drives in driven(trained, segments).items():
        for force in FORCES:
            left = disturbed(
                trained, params, drives, certificate["d_bar"]["one_step"], force
            )
            yield {
                "vehicle": plant,
                "scenario": scenario,
                "force_n": force,
                "left": left,
            }
        result = jax.device_get(predict(params, drives))
        about = {"vehicle": plant, "scenario": scenario}
        yield about | {"claim": "as certified", **measured(result, alpha, d_bar)}
        for forged in FORGED_ALPHA:
            yield about | {
                "claim": f"alpha {forged:g}",
                **measured(result, forged, d_bar),
            }
        for factor in FORGED_D_BAR:
            yield about | {
                "claim": f"d_bar x {factor:g}",
                **measured(result, alpha, factor * d_bar),
            }
        for factor in SHORTER:
            other = jax.device_get(predict(lengthened(params, factor), drives))
            yield about | {
                "claim": f"A(e) x {factor:g}",
                **measured(other, alpha, d_bar),
            }


def main():
    """Measure both plants."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--segments", type=int, default=400)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    result = [
        row for plant in ("kinematic", "dynamic") for row in rows(plant, args.segments)
    ]
    document = {
        "rows": result,
        "segments": args.segments,
        "versions": store.versions(),
    }
    if args.out:
        store.write_json(args.out, document)
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
