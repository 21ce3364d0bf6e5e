"""python -m sfkd_jax.train: the main job, from nothing to a certified controller, its score and a report."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import jax

from sfkd_jax import artefacts, assembly, certify, evaluate, generate, policy, report, shelf
from sfkd_jax.config import door
from sfkd_jax.datasets import measure_space, random_windows, spread_windows
from sfkd_jax.evaluation import open_loop
from sfkd_jax.training import fit, multi_step_loss


def fit_policy(settings: dict[str, Any]) -> policy.Policy:
    """Train the policy of this run, or continue, or take it from the shelf; refuse one made with other settings."""
    place = shelf.run_directory(settings)
    shelf.claim(settings)
    if artefacts.exists(place / "policy.npz"):
        return policy.load(place)
    dataset, data_hash = shelf.read_dataset(settings)
    space = measure_space(dataset)
    model = assembly.build_model(settings["model"], space)
    options = dict(settings["training"])
    loss = multi_step_loss(model, space, **options.pop("loss"))
    shelf.say(f"training {settings['model']['system']}, {options['steps']} steps, in {place}")
    key = shelf.streams(settings["seed"])["training"]
    horizon = options.pop("window")
    draw = partial(random_windows, batch=options.pop("batch"), length=horizon)
    held_out = spread_windows(dataset.validation, length=horizon)
    params, best = fit(model, loss, draw, dataset.train, held_out, key, place, **options)
    kept = shelf.identity(settings) | {"controller": settings["controller"], "experiment": settings["name"]}
    kept |= {"space": assembly.space_to_settings(space), "best_step": best}
    policy.save(place / "policy.npz", params, kept, made_from={"dataset": data_hash})
    errors = jax.jit(partial(open_loop, model, horizon=horizon))(params, dataset.test)
    document = shelf.open_loop_document(errors, dataset.test, settings["vehicle"]["dt"])
    artefacts.write_json(place / "open_loop.json", document)
    return policy.load(place)


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Walk: data, weights, certificate, closed loop, report."""
    began = time.perf_counter()
    generate.run(settings)
    fit_policy(settings)
    place = shelf.run_directory(settings)
    certificate = certify.renew(settings)
    results = evaluate.run(settings)
    pages = report.run(settings)
    return {
        "run": str(place),
        "checkpoint": str(place / "checkpoints"),
        "certificate": str(place / "certificate.json"),
        "results": results["results"],
        "report": pages["report"],
        "open_loop_rmse_m": artefacts.read_json(place / "open_loop.json")["position_rmse_m"],
        "alpha": certificate.get("alpha"),
        "seconds": time.perf_counter() - began,
    }


if __name__ == "__main__":
    door(run)()
