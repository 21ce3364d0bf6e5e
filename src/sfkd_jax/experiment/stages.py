"""Policy and certificate of a run: loaded if they exist, made if they do not."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax.numpy as jnp

from sfkd_jax import build, policy, store
from sfkd_jax.certification import CertificationRefused, issue
from sfkd_jax.certification.corridor import certify_corridor, check_count, closed_loop
from sfkd_jax.control import PathLaw
from sfkd_jax.data import check_shares
from sfkd_jax.experiment import data, runs
from sfkd_jax.experiment.fitting import train_policy
from sfkd_jax.experiment.options import Settings
from sfkd_jax.plants import Vehicle, check_step
from sfkd_jax.ranges import imported
from sfkd_jax.settings import arguments, choose
from sfkd_jax.types import BODY, Space


def check_settings(settings: Settings) -> None:
    """Build what the settings choose, with unit scales and without a certificate.

    A long run then fails before its first hour, not after it.
    """
    plant = build.build_vehicle(settings.vehicle)
    if plant.simulated:
        check_step(plant, len(settings.environment.low or (0, 0)))
    check_shares(settings.dataset.shares)
    window = settings.training.window
    if window > settings.dataset.steps:
        raise ValueError(
            f"training.window={window} does not fit segments "
            f"of dataset.steps={settings.dataset.steps}"
        )
    sizes = _sizes(settings, plant)
    law = _zero_law(sizes) if settings.along_path else None
    systems = ["self", *build.reference_systems(plant, law)]
    if law is not None:
        systems.extend(build.LAWS_ALONE)
    for name in settings.evaluation.systems:
        choose(dict.fromkeys(systems), name, "evaluation.systems entry")
    model = build.build_model(settings.model, _unit_space(sizes), plant)
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
        env_low=(-1.0,) * sizes.env,
        env_high=(1.0,) * sizes.env,
        law=law,
        env_source=settings.environment.source,
    )


class _Sizes(NamedTuple):
    """Numbers of entries of body state, control and environment."""

    body: int
    control: int
    env: int


def _sizes(settings: Settings, plant: Vehicle) -> _Sizes:
    """Return the sizes of what the model reads."""
    if settings.logs:
        env = len(settings.logs.columns.environment)
    else:
        env = len(settings.environment.low or ())
    # Without a box of e it is friction and wind.
    env = env or 2
    body = len(plant.state_names) - 3
    if settings.along_path:
        # e_y and e_ψ in place of the pose; w = (ν, κ, v_ref) has four entries.
        return _Sizes(body=body + 2, control=4, env=env)
    return _Sizes(body=body, control=2, env=env)


def _unit_space(sizes: _Sizes) -> Space:
    """Return the scales of data that are centred at 0 and reach from -1 to 1."""
    increment = 3
    scales = []
    for size in (*sizes, increment):
        scales.append(jnp.zeros(size))
        scales.append(jnp.ones(size))
    return Space(*scales)


def _zero_law(sizes: _Sizes) -> PathLaw:
    """Return a law whose output is zero."""
    # Lateral acceleration, speed and e; two points an axis are the fewest that can be
    # interpolated.
    axes = 2 + sizes.env
    grid = (2,) * axes
    return PathLaw(
        low=jnp.zeros(axes),
        high=jnp.ones(axes),
        perturbation=jnp.ones(2),
        state=jnp.zeros((*grid, sizes.body)),
        control=jnp.zeros((*grid, 2)),
        gain=jnp.zeros((*grid, 2, sizes.body)),
    )


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
                dataset, data_hash = data.ensure_dataset(settings)
                train_policy(settings, dataset, data_hash)
    # Also of a policy that exists: it must have been made with these settings.
    runs.claim(settings)
    return policy.restore(settings.run_dir)


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
    document["weights_sha256"] = trained.weights_sha256
    document["policy_sha256"] = trained.sha256
    document["certification"] = _recorded_certification(settings)
    # The proof's own versions win: they are of the libraries that computed it.
    document["versions"] = {**store.versions(), **document.get("versions", {})}
    document["seconds"] = time.perf_counter() - began
    store.write_json(settings.certificate_path, document)
    store.print_message(f"certificate: {_verdict(document)}")
    lyapunov_refused = document.get("lyapunov", {}).get("reason")
    if lyapunov_refused:
        store.print_message(f"certificate: {lyapunov_refused}")
    return document


def _verdict(document: dict[str, Any]) -> str:
    """Return what a certificate proves and measures, in one line."""
    verdict = f"refused: {document.get('reason')}"
    if document["valid"]:
        verdict = f"alpha {document['alpha']:.6f}"
    if corridor := document.get("corridor"):
        verdict += f"; corridor {corridor['corridor_m']:.3f} m to each side, measured"
        if "identified_from" in corridor["conditions"]:
            verdict += " on the model of the logs, not on the car"
    if d_bar := document.get("d_bar"):
        holds = f"holds for {d_bar['holds_for']} (measured, unsigned)"
        verdict += f"; d_bar {d_bar['value']:.4g} {holds}"
    return verdict


def _recorded_certification(settings: Settings) -> dict[str, Any]:
    """Return the settings of the certification that a certificate records."""
    recorded = store.plain(settings.certification)
    # `renew` says what to do, not what is claimed.
    del recorded["renew"]
    return recorded


def _certify_tubes(settings: Settings, trained: policy.TrainedModel) -> dict[str, Any]:
    """Certify the steps of a model, with tubes calibrated on the data of the run."""
    dataset, _ = data.ensure_dataset(settings)
    boxes: dict[str, Any] = data.boxes(dataset)
    if settings.logs:
        boxes["names"] = _column_names(settings)
    document = issue(
        trained.model,
        trained.params,
        validation=dataset.validation,
        calibration=dataset.calibration,
        held_out=data.held_out_parts(settings, dataset),
        boxes=boxes,
        runs=dataset.runs,
        **arguments(settings.certification, issue),
    )
    # Logs have no plant to drive: a corridor needs runs under known conditions.
    if document["outputs"] and settings.logs is None:
        document["corridor"] = _measure_corridor(settings, trained, document["outputs"])
    return document


def _column_names(settings: Settings) -> dict[str, Any]:
    """Return the names of the axes of the boxes, from the columns of the logs."""
    logs: Any = settings.logs
    env = logs.columns.environment if settings.environment.is_known else ()
    names = {
        "state": logs.columns.state[BODY],
        "control": logs.columns.control,
        "env": env,
    }
    return store.plain(names)


def _measure_corridor(
    settings: Settings, trained: policy.TrainedModel, outputs: Any
) -> dict[str, Any]:
    """Return the corridor of a policy, measured on runs of its vehicle.

    Args:
        settings: of the run.
        trained: the policy.
        outputs: the outputs of its certificate.
    """
    plant = build.build_vehicle(settings.vehicle)
    loop = closed_loop(
        plant,
        trained.model,
        trained.params,
        trained.law,
        settings.sensors(plant),
    )
    corridor = certify_corridor(
        loop,
        outputs,
        {**store.plain(settings.dataset), **settings.environment.box},
        settings.certification.level,
        **arguments(settings.certification.corridor, certify_corridor),
    )
    if contents := getattr(settings.vehicle, "contents", None):
        corridor["conditions"]["identified_from"] = contents
    return corridor


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
            if not store.differences(recorded, _recorded_certification(settings)):
                return
        certify_policy(settings)
