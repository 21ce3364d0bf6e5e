"""What a run is checked for before it is made, and its certificate."""

from __future__ import annotations

import dataclasses
import time
from importlib.metadata import version
from typing import Any, NamedTuple

import jax.numpy as jnp

from sfkd_jax import assembly, policy, store
from sfkd_jax.certificate import (
    AxisNames,
    Proof,
    Provenance,
    Refusal,
    private_key,
    write,
)
from sfkd_jax.certification import CertificationRefused, boxes_of, measure, prove
from sfkd_jax.data import check_shares
from sfkd_jax.driving.certificate import Corridor, DrivingCertificate
from sfkd_jax.driving.corridor import closed_loop, measure_corridor
from sfkd_jax.driving.path_following import PathLaw
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
    if model.frame.has_pose == (law is not None):
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
        latency=run.latency,
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


def certify_policy(run: Run) -> DrivingCertificate | Refusal:
    """Certify the policy of the run, and write and return the certificate."""
    began = time.perf_counter()
    settings = run.settings.certification
    if settings.signing_key is not None:
        # Whether it is a key is known before the hours that the rest may take.
        private_key(settings.signing_key)
    trained = run.policy
    provenance = Provenance(
        policy_sha256=trained.sha256,
        weights_sha256=trained.weights_sha256,
        versions={**store.versions(), "scipy": version("scipy")},
        seconds=0.0,
        settings=_recorded_certification(run),
    )
    try:
        certificate: DrivingCertificate | Refusal = _certify(run, trained, provenance)
    except CertificationRefused as reason:
        certificate = Refusal(reason=str(reason), provenance=provenance)
    seconds = time.perf_counter() - began
    provenance = dataclasses.replace(certificate.provenance, seconds=seconds)
    certificate = dataclasses.replace(certificate, provenance=provenance)
    key = settings.signing_key
    try:
        write(run.certificate_path, certificate, signing_key=key)
    except ValueError as reason:
        unreadable = f"what was measured is no certificate: {reason}"
        certificate = Refusal(reason=unreadable, provenance=provenance)
        write(run.certificate_path, certificate, signing_key=key)
    store.print_message(f"certificate: {_verdict(certificate, settings)}")
    if not isinstance(certificate, Refusal) and certificate.proof.lyapunov_refused:
        store.print_message(f"certificate: {certificate.proof.lyapunov_refused}")
    return certificate


def _verdict(
    certificate: DrivingCertificate | Refusal, settings: CertificationSettings
) -> str:
    """Return what a certificate proves and measures, in one line."""
    if isinstance(certificate, Refusal):
        return f"refused: {certificate.reason}"
    verdict = f"alpha {certificate.proof.alpha:.6f}"
    if corridor := certificate.corridor:
        verdict += f"; corridor {corridor.corridor_m:.3f} m to each side, measured"
        if corridor.conditions.identified_from is not None:
            verdict += " on the model of the logs, not on the car"
    d_bar = certificate.measured.d_bar
    signature = "signed" if settings.signing_key else "unsigned"
    holds = f"holds for {d_bar.holds_for} (measured, {signature})"
    return f"{verdict}; d_bar {d_bar.one_step['latent']:.4g} {holds}"


def _recorded_certification(run: Run) -> dict[str, Any]:
    """Return the settings of the certification that a certificate records."""
    recorded = store.plain(run.settings.certification)
    if not run.latency.is_none:
        recorded["latency"] = store.plain(dataclasses.asdict(run.latency))
    # They say what to do, and not what is claimed.
    del recorded["renew"]
    del recorded["signing_key"]
    return recorded


def _certify(
    run: Run, trained: policy.TrainedModel, provenance: Provenance
) -> DrivingCertificate:
    """Prove, and measure on the data of the run and on runs of its vehicle."""
    dataset = run.source.dataset
    settings = run.settings.certification
    boxes = boxes_of(dataset)
    if logs := run.source.logs:
        names = _column_names(logs, run.settings.environment)
        boxes = dataclasses.replace(boxes, names=names)
    began = time.perf_counter()
    proof = prove(
        trained.model,
        trained.params,
        boxes.env,
        validation=dataset.validation,
        **arguments(settings, prove),
    )
    seconds = time.perf_counter() - began
    measured = measure(
        trained.model,
        trained.params,
        proof,
        validation=dataset.validation,
        calibration=dataset.calibration,
        held_out=run.source.held_out,
        boxes=boxes,
        runs=dataset.runs,
        **arguments(settings, measure),
    )
    corridor = None
    # Logs have no plant to drive: a corridor needs runs under known conditions.
    if proof.outputs and run.source.logs is None:
        corridor = _measure_corridor(run, trained, proof)
    return DrivingCertificate(
        proof=proof,
        measured=measured,
        corridor=corridor,
        provenance=dataclasses.replace(provenance, seconds_proof=seconds),
    )


def _column_names(logs: LogSettings, environment: EnvironmentSettings) -> AxisNames:
    """Return the names of the axes of the boxes, from the columns of the logs."""
    env = logs.columns.environment if environment.is_known else ()
    return AxisNames(
        state=tuple(logs.columns.state[BODY]),
        control=tuple(logs.columns.control),
        env=tuple(env),
    )


def _measure_corridor(run: Run, trained: policy.TrainedModel, proof: Proof) -> Corridor:
    """Return the corridor of a policy, measured on runs of its vehicle."""
    settings = run.settings
    loop = closed_loop(
        run.plant,
        trained.model,
        trained.params,
        trained.law,
        run.sensors,
        run.latency,
    )
    return measure_corridor(
        loop,
        proof.outputs,
        {**store.plain(settings.dataset), **run.source.box},
        settings.certification.level,
        identified_from=getattr(settings.vehicle, "contents", None),
        **arguments(settings.certification.corridor, measure_corridor),
    )


def ensure_certificate(run: Run) -> None:
    """Train and certify the policy of the run, unless both exist.

    A certificate of other settings of the certification is made again.
    """
    # Another process may be training it.
    with store.locked(run.directory, wait=True):
        # Trained in any case: this checks that the policy has these settings.
        _ = run.policy
        if (path := run.certificate_path).exists():
            recorded = store.read_json(path).get("provenance", {}).get("settings")
            wanted = _recorded_certification(run)
            if not store.differences(recorded or {}, wanted):
                return
        certify_policy(run)
