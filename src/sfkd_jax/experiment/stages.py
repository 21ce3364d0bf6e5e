"""What a run is checked for before it is made, and its certificate."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax.numpy as jnp

from sfkd_jax import assembly, policy, store
from sfkd_jax.certification import CertificationRefused, issue
from sfkd_jax.certification.corridor import certify_corridor, closed_loop
from sfkd_jax.control import PathLaw
from sfkd_jax.data import check_shares
from sfkd_jax.experiment import data
from sfkd_jax.experiment.options import (
    CertificationSettings,
    EnvironmentSettings,
    LogSettings,
)
from sfkd_jax.experiment.run import Run
from sfkd_jax.experiment.source import DataSource
from sfkd_jax.settings import arguments, choose
from sfkd_jax.types import BODY, Space


def check_settings(run: Run) -> None:
    """Build what the settings choose, with unit scales and without a certificate.

    A long run then fails before its first hour, not after it.
    """
    settings = run.settings
    plant = run.plant
    if plant.simulated:
        run.source.check_plant()
    check_shares(settings.dataset.shares)
    window = settings.training.window
    if window > settings.dataset.steps:
        raise ValueError(
            f"training.window={window} does not fit segments "
            f"of dataset.steps={settings.dataset.steps}"
        )
    sizes = _sizes(run.source)
    law = _zero_law(sizes) if run.source.along_path else None
    systems = ["self", *assembly.reference_systems(plant, law)]
    if law is not None:
        systems.extend(assembly.LAWS_ALONE)
    for name in settings.evaluation.systems:
        choose(dict.fromkeys(systems), name, "evaluation.systems entry")
    model = assembly.build_model(settings.model, _unit_space(sizes), plant)
    if model.along_path != (law is not None):
        raise ValueError(
            "model.frame=path and dataset=path go together: "
            "path coordinates for both or for neither"
        )
    if not plant.control_low:  # known from logs alone, and not driven
        return
    assembly.build_scenario(
        settings.scenario, plant, duration=settings.evaluation.episode_s
    )
    assembly.build_controller(
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


def _sizes(source: DataSource) -> _Sizes:
    """Return the sizes of what the model reads."""
    if source.logs:
        env = len(source.logs.columns.environment)
    else:
        env = len(source.environment.low or ())
    # Without a box of e it is friction and wind.
    env = env or 2
    body = len(source.plant.states) - 3
    if source.along_path:
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


def certify_policy(run: Run) -> dict[str, Any]:
    """Certify the policy of the run, and write and return the document.

    A refusal is a document too: `valid` is false, and `reason` is given.
    """
    began = time.perf_counter()
    trained = run.policy
    try:
        document = _certify_tubes(run, trained)
    except CertificationRefused as reason:
        document = {"valid": False, "reason": str(reason)}
    document["weights_sha256"] = trained.weights_sha256
    document["policy_sha256"] = trained.sha256
    document["certification"] = _recorded_certification(run.settings.certification)
    # The proof's own versions win: they are of the libraries that computed it.
    document["versions"] = {**store.versions(), **document.get("versions", {})}
    document["seconds"] = time.perf_counter() - began
    store.write_json(run.certificate_path, document)
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


def _recorded_certification(settings: CertificationSettings) -> dict[str, Any]:
    """Return the settings of the certification that a certificate records."""
    recorded = store.plain(settings)
    # `renew` says what to do, not what is claimed.
    del recorded["renew"]
    return recorded


def _certify_tubes(run: Run, trained: policy.TrainedModel) -> dict[str, Any]:
    """Certify the steps of a model, with tubes calibrated on the data of the run."""
    dataset = run.source.dataset
    boxes: dict[str, Any] = data.boxes(dataset)
    if logs := run.source.logs:
        boxes["names"] = _column_names(logs, run.settings.environment)
    document = issue(
        trained.model,
        trained.params,
        validation=dataset.validation,
        calibration=dataset.calibration,
        held_out=run.source.held_out,
        boxes=boxes,
        runs=dataset.runs,
        **arguments(run.settings.certification, issue),
    )
    # Logs have no plant to drive: a corridor needs runs under known conditions.
    if document["outputs"] and run.source.logs is None:
        document["corridor"] = _measure_corridor(run, trained, document["outputs"])
    return document


def _column_names(
    logs: LogSettings, environment: EnvironmentSettings
) -> dict[str, Any]:
    """Return the names of the axes of the boxes, from the columns of the logs."""
    env = logs.columns.environment if environment.is_known else ()
    names = {
        "state": logs.columns.state[BODY],
        "control": logs.columns.control,
        "env": env,
    }
    return store.plain(names)


def _measure_corridor(
    run: Run, trained: policy.TrainedModel, outputs: Any
) -> dict[str, Any]:
    """Return the corridor of a policy, measured on runs of its vehicle.

    Args:
        run: whose policy it is.
        trained: the policy.
        outputs: the outputs of its certificate.
    """
    settings = run.settings
    loop = closed_loop(
        run.plant,
        trained.model,
        trained.params,
        trained.law,
        run.sensors,
    )
    corridor = certify_corridor(
        loop,
        outputs,
        {**store.plain(settings.dataset), **run.source.box},
        settings.certification.level,
        **arguments(settings.certification.corridor, certify_corridor),
    )
    if contents := getattr(settings.vehicle, "contents", None):
        corridor["conditions"]["identified_from"] = contents
    return corridor


def ensure_certificate(run: Run) -> None:
    """Train and certify the policy of the run, unless both exist.

    A certificate of other settings of the certification is made again.
    """
    # Another process may be training it.
    with store.locked(run.directory, wait=True):
        # Trained in any case: this checks that the policy has these settings.
        _ = run.policy
        if (path := run.certificate_path).exists():
            recorded = store.read_json(path).get("certification", {})
            wanted = _recorded_certification(run.settings.certification)
            if not store.differences(recorded, wanted):
                return
        certify_policy(run)
