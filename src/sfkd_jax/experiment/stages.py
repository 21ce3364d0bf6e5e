"""Policy and certificate of a run: loaded if they exist, made if they do not."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import build, policy, store
from sfkd_jax.certification import CertificationRefused, issue
from sfkd_jax.certification.corridor import certify_corridor, check_count, closed_loop
from sfkd_jax.control import PathLaw
from sfkd_jax.data import (
    SCENARIOS,
    Dataset,
    check_shares,
    measure_space,
    random_windows,
    spread_windows,
)
from sfkd_jax.evaluation import open_loop
from sfkd_jax.experiment import data, identified, runs
from sfkd_jax.experiment.options import Settings
from sfkd_jax.models import physics
from sfkd_jax.plants import Vehicle, check_step
from sfkd_jax.ranges import imported, in_words
from sfkd_jax.rollout import fold, on_host
from sfkd_jax.settings import arguments, choose
from sfkd_jax.training import descend, fit, multi_step_loss, planning_loss
from sfkd_jax.types import BODY, Model, Params, Space, Trajectory

SCORED_SCENARIOS = ("uniform", "wet")
"""Of the validation runs that trainings are compared on: S3 stays unseen."""
PLANNING_BATCH, PLANNING_RATE, PLANNING_STEPS = 256, 0.01, 2
"""Of g: single steps in a batch, learning rate, and steps for each of the model's."""


def check_settings(settings: Settings) -> None:
    """Build what the settings choose, with unit scales and without a certificate.

    A long run then fails before its first hour, not after it.
    """
    plant = build.build_vehicle(settings.vehicle)
    if plant.simulated:
        check_step(plant, len(settings.environment.low or (0, 0)))
    options, window = settings.dataset, settings.training.window
    check_shares(options.shares)
    if window > options.steps:
        raise ValueError(
            f"training.window={window} does not fit segments "
            f"of dataset.steps={options.steps}"
        )
    sizes = _sizes(settings, plant)
    law = _zero_law(sizes) if settings.along_path else None
    systems = {"self": None} | build.reference_systems(plant, law)
    systems |= dict.fromkeys(build.LAWS_ALONE) if law else {}
    for name in settings.evaluation.systems:
        choose(systems, name, "evaluation.systems entry")
    scales = (part(n) for n in (*sizes.values(), 3) for part in (jnp.zeros, jnp.ones))
    model = build.build_model(settings.model, Space(*scales), plant)
    if model.along_path != (law is not None):
        raise ValueError(
            "model.frame=path and dataset=path go together: "
            "path coordinates for both or for neither"
        )
    if not plant.control_low:  # known from logs alone, and not driven
        return
    build.build_scenario(
        settings.scenario, plant, duration=settings.evaluation.episode_s
    )
    build.build_controller(
        settings.controller,
        model,
        plant,
        env_low=(-1.0,) * sizes["env"],
        env_high=(1.0,) * sizes["env"],
        law=law,
        env_source=settings.environment.source,
    )


def _sizes(settings: Settings, plant: Vehicle) -> dict[str, int]:
    """Sizes of body state, control and environment that the model reads."""
    logs, low = settings.logs, settings.environment.low or ()
    env = len(logs.columns.environment if logs else low) or 2
    state = len(plant.state_names) - 3
    # e_y and e_ψ in place of the pose; w = (ν, κ, v_ref) has four entries.
    if settings.along_path:
        return {"state": state + 2, "control": 4, "env": env}
    return {"state": state, "control": 2, "env": env}


def _zero_law(sizes: Mapping[str, int]) -> PathLaw:
    """A law whose output is zero."""
    # Two points an axis, the fewest that can be interpolated.
    axes, corners = 2 + sizes["env"], (2,) * (2 + sizes["env"])
    shapes = (sizes["state"],), (2,), (2, sizes["state"])
    tables = (np.zeros((*corners, *shape), np.float32) for shape in shapes)
    ends = np.zeros(axes, np.float32), np.ones(axes, np.float32)
    return PathLaw(*map(jnp.asarray, (*ends, np.ones(2, np.float32), *tables)))


def ensure_policy(settings: Settings) -> policy.TrainedModel:
    """Return the policy of the run; train it, or train it on, if it is missing."""
    # Before the lock and the data: a missing module ends the command at once.
    if factory := getattr(settings.model, "factory", None):
        imported(factory, "model.factory")
    if not settings.policy_path.is_file():
        # Whether logs are too few for the level is known before the training.
        if settings.logs:
            dataset, _ = data.ensure_dataset(settings)
            count = len(dataset.calibration.controls)
            check_count(count, settings.certification.level, "calibration segments")
        with store.locked(settings.run_dir):
            runs.claim(settings)
            # Once more under the lock, where nobody else can be writing.
            if not settings.policy_path.is_file():
                _train(settings, *data.ensure_dataset(settings))
    # Also of a policy that exists: it must have been made with these settings.
    runs.claim(settings)
    return policy.restore(settings.run_dir)


def _train(settings: Settings, dataset: Dataset, data_hash: str) -> None:
    """Train, then write the best weights and their errors on the test part."""
    run_dir, options = settings.run_dir, settings.training
    recorded = runs.policy_settings(settings, dataset)
    space = measure_space(dataset)
    recorded["space"] = space._asdict()
    # That of `restore`, for which everything is then compiled already.
    plant, model = policy.built(recorded)
    names = settings.environment.names or [one.label for one in plant.environment]
    if settings.environment.is_known and not settings.logs:
        box = in_words(names, dataset.env_low, dataset.env_high)
        store.print_message(f"the model reads e: {box}")
    loss = multi_step_loss(model, space, **arguments(options.loss, multi_step_loss))
    # Fixed windows: validation losses at different steps are comparable.
    held_out = spread_windows(dataset.validation, length=options.window)
    key, best = jax.random.fold_in(jax.random.key(settings.seed), 0), None
    if model.fitting.identify is not None:
        store.print_message(f"identifying {settings.model.system} in {run_dir}")
        params = model.fitting.identify(dataset.train, dataset.validation, key)
    else:
        store.print_message(
            f"training {settings.model.system}, {options.steps} steps, in {run_dir}"
        )
        params, best = fit(
            model,
            loss,
            partial(random_windows, batch=options.batch, length=options.window),
            dataset.train,
            held_out,
            key,
            run_dir,
            **arguments(options, fit),
        )
    if model.planning is not None:
        store.print_message("training what planners add to its steps")
        added = descend(
            params["planning"],
            planning_loss(model, params, space),
            partial(random_windows, batch=PLANNING_BATCH, length=1),
            dataset.train,
            jax.random.fold_in(key, 1),
            steps=PLANNING_STEPS * options.steps,
            learning_rate=PLANNING_RATE,
        )
        params = {**params, "planning": added}
    document = _open_loop_document(settings, model, params, dataset)
    scores = np.asarray(loss.validate(params, held_out)[2])
    if dataset.scenarios is not None:
        wanted = [SCENARIOS.index(name) for name in SCORED_SCENARIOS]
        rows = np.isin(dataset.scenarios["validation"], wanted)
        # Several windows of every run, of one position in all runs after another.
        scores = scores.reshape(-1, rows.size)[:, rows]
    document["validation_score"] = float(scores.mean())
    store.write_json(run_dir / "open_loop.json", document)
    recorded["best_step"] = best
    policy.save(
        settings.policy_path,
        params,
        recorded,
        made_from={"dataset": data_hash},
        law=data.ensure_law(settings),
    )


def _open_loop_document(
    settings: Settings, model: Model, params: Params, dataset: Dataset
) -> dict[str, Any]:
    """The content of open_loop.json: errors by steps ahead, and of simple models."""
    along, horizon = settings.along_path is not None, settings.training.window
    plant = (
        data.closed_loop(settings) if along else build.build_vehicle(settings.vehicle)
    )
    simple = {"kinematic_bicycle": plant.nominal}
    # Controls along a path are perturbations of a law, which is not linear.
    if not along:
        simple["least_squares"] = identified.least_squares(dataset)
    others = {name: physics(step, along_path=along) for name, step in simple.items()}

    @jax.jit
    def errors(params: Params, test: Trajectory) -> tuple[jax.Array, dict[str, Any]]:
        own = open_loop(model, params, test, horizon=horizon)
        return own, {
            name: open_loop(one, {}, test, horizon=horizon)
            for name, one in others.items()
        }

    def columns(errors: jax.Array) -> dict[str, list[float]]:
        """Errors by coordinate as lists over the steps ahead."""
        along, lateral, yaw, speed, *_ = np.asarray(errors, dtype=np.float64).T
        return {
            "position_rmse_m": np.hypot(along, lateral).tolist(),
            "longitudinal_rmse_m": along.tolist(),
            "lateral_rmse_m": lateral.tolist(),
            "yaw_rmse_rad": yaw.tolist(),
            "speed_rmse_m_per_s": speed.tolist(),
        }

    own, of_others = errors(fold(model, params, on_host), dataset.test)
    return {
        "steps": list(range(1, horizon + 1)),
        "dt": plant.dt,
        "trajectories": dataset.test.controls.shape[0],
        **columns(own),
        # Of ξ, as `control.Adaptation.model_error` takes them, or of all states.
        "one_step_rmse": np.asarray(own, np.float64)[0, int(along) :].tolist(),
        "baselines": {name: columns(one) for name, one in of_others.items()},
    }


def certify_policy(settings: Settings) -> dict[str, Any]:
    """Certify the policy of the run, and write and return the document.

    A refusal is a document too: `valid` is false, and `reason` is given.
    """
    began = time.perf_counter()
    trained = ensure_policy(settings)
    try:
        document = _certify_tubes(settings, trained)
    except CertificationRefused as reason:
        document = {"valid": False, "reason": str(reason)}
    document |= {
        "weights_sha256": trained.weights_sha256,
        "policy_sha256": trained.sha256,
        "certification": _asked_for(settings),
        # The proof's own versions win: they are of the libraries that computed it.
        "versions": store.versions() | document.get("versions", {}),
        "seconds": time.perf_counter() - began,
    }
    store.write_json(settings.certificate_path, document)
    verdict = f"refused: {document.get('reason')}"
    if document["valid"]:
        verdict = f"alpha {document['alpha']:.6f}"
    if corridor := document.get("corridor"):
        verdict += f"; corridor {corridor['corridor_m']:.3f} m to each side, measured"
        if "identified_from" in corridor["conditions"]:
            verdict += " on the model of the logs, not on the car"
    if d_bar := document.get("d_bar"):
        about = f"holds for {d_bar['holds_for']} (measured, unsigned)"
        verdict += f"; d_bar {d_bar['value']:.4g} {about}"
    for line in (verdict, document.get("lyapunov", {}).get("reason")):
        if line:
            store.print_message(f"certificate: {line}")
    return document


def _asked_for(settings: Settings) -> dict[str, Any]:
    """The settings of the certification that a certificate records."""
    asked = store.plain(settings.certification)
    # `renew` says what to do, not what is claimed.
    return {name: value for name, value in asked.items() if name != "renew"}


def _certify_tubes(settings: Settings, trained: policy.TrainedModel) -> dict[str, Any]:
    """Certify the steps of a model, with tubes calibrated on the data of the run."""
    options = settings.certification
    dataset, _ = data.ensure_dataset(settings)
    boxes: dict[str, Any] = data.boxes(dataset)
    if settings.logs:
        named = settings.logs.columns
        env = named.environment if settings.environment.is_known else ()
        names = {"state": named.state[BODY], "control": named.control, "env": env}
        boxes |= {"names": store.plain(names)}
    document = issue(
        trained.model,
        trained.params,
        validation=dataset.validation,
        calibration=dataset.calibration,
        held_out=data.held_out_parts(settings, dataset),
        boxes=boxes,
        runs=dataset.runs,
        **arguments(options, issue),
    )
    # Logs have no plant to drive: a corridor needs runs under known conditions.
    if document["outputs"] and settings.logs is None:
        plant = build.build_vehicle(settings.vehicle)
        loop = closed_loop(
            plant,
            trained.model,
            trained.params,
            trained.law,
            settings.sensors(plant),
        )
        document["corridor"] = certify_corridor(
            loop,
            document["outputs"],
            store.plain(settings.dataset) | settings.environment.box,
            options.level,
            **arguments(options.corridor, certify_corridor),
        )
        if contents := getattr(settings.vehicle, "contents", None):
            document["corridor"]["conditions"]["identified_from"] = contents
    return document


def ensure_certificate(settings: Settings) -> None:
    """Train and certify the policy of the run, unless both exist.

    A certificate of other settings of the certification is made again.
    """
    # Another process may be training it.
    with store.locked(settings.run_dir, wait=True):
        # Called in any case: it checks that the policy has these settings.
        ensure_policy(settings)
        if (path := settings.certificate_path).exists():
            recorded = store.read_json(path).get("certification", {})
            if not store.differences(recorded, _asked_for(settings)):
                return
        certify_policy(settings)
