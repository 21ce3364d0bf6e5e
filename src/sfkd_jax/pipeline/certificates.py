"""Certify the policy of a run and write the certificate."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from sfkd_jax import build, policy, store
from sfkd_jax.certification import (
    CertificationRefused,
    certify_incremental,
    is_incremental,
    issue,
    output_metrics_from,
)
from sfkd_jax.corridor import certify_corridor
from sfkd_jax.pipeline import runs, stages

INCREMENTAL = "incremental.json"
"""File for the rate of a continuous flow, which has no tubes and no monitor bounds."""


def certificate_path(run_dir: Path) -> Path:
    """Return the path of the certificate of a run, whether or not it exists."""
    incremental = run_dir / INCREMENTAL
    return incremental if incremental.exists() else run_dir / policy.CERTIFICATE


def certify_policy(settings: dict[str, Any]) -> dict[str, Any]:
    """Certify the policy of the run, and write and return the document.

    A refusal is a document too: `valid` is false, and `reason` is given.
    """
    began = time.perf_counter()
    run_dir = runs.run_directory(settings)
    trained = stages.ensure_policy(settings)
    incremental = is_incremental(trained.model, trained.params)
    certify = _certify_rate if incremental else _certify_tubes
    try:
        document = certify(settings, trained)
    except CertificationRefused as reason:
        document = {"valid": False, "reason": str(reason)}
    versions = store.versions() | document.get("versions", {})
    document |= {
        "weights_sha256": trained.weights_sha256,
        "policy_sha256": trained.sha256,
        "certification": build.as_kwargs(settings["certification"], "renew"),
        "versions": versions,
    }
    document["seconds"] = time.perf_counter() - began
    names = (INCREMENTAL, policy.CERTIFICATE)
    written, stale = names if incremental else reversed(names)
    (run_dir / stale).unlink(missing_ok=True)
    store.write_json(run_dir / written, document)
    store.print_message(f"certificate: {_verdict(document)}")
    return document


def _verdict(document: dict[str, Any]) -> str:
    """Summarise a document in one line."""
    verdict = (
        f"alpha {document['alpha']:.6f}"
        if document["valid"]
        else f"refused: {document['reason']}"
    )
    if "d_bar" in document:
        d_bar = document["d_bar"]
        verdict += f"; d_bar {d_bar['value']:.4g} holds for {d_bar['holds_for']}"
    return verdict


def _certify_rate(
    settings: dict[str, Any], trained: policy.TrainedModel
) -> dict[str, Any]:
    """Certify the contraction rate of a continuous flow."""
    return certify_incremental(
        trained.model, trained.params, dt=settings["vehicle"]["dt"]
    )


def _certify_tubes(
    settings: dict[str, Any], trained: policy.TrainedModel
) -> dict[str, Any]:
    """Certify the steps of a model, with tubes calibrated on the data of the run."""
    dataset, _ = stages.ensure_dataset(settings)
    is_logged = runs.is_logged(settings)
    options = build.as_kwargs(settings["certification"], "renew", "corridor")
    boxes = runs.boxes(dataset)
    noise = tuple(settings["evaluation"]["observation_noise"])
    if is_logged:  # the noise of the sensors is already in the logs
        boxes, noise = boxes | {"names": runs.channel_names(settings)}, ()
    document = issue(
        trained.model,
        trained.params,
        validation=dataset.validation,
        calibration=dataset.calibration,
        held_out=stages.held_out_parts(settings, dataset),
        boxes=boxes,
        drives=dataset.drives,
        sensor_noise=noise,
        **options,
    )
    if document["outputs"] and not is_logged:
        document["corridor"] = certify_corridor(
            settings,
            trained,
            output_metrics_from(document["outputs"]),
            **build.as_kwargs(settings["certification"]["corridor"]),
        )
    return document


def ensure_certificate(settings: dict[str, Any]) -> None:
    """Train and certify the policy of the run, unless both exist.

    A certificate of other settings of the certification is made again.
    """
    run_dir = runs.run_directory(settings)
    if store.exists(run_dir / "policy.npz") and _is_certified(settings):
        stages.ensure_policy(settings)
        return
    with store.locked(run_dir, wait=True):  # another process may be training it
        stages.ensure_policy(settings)
        if not _is_certified(settings):
            certify_policy(settings)


def _is_certified(settings: dict[str, Any]) -> bool:
    """Whether there is a certificate or a refusal with these settings.

    Older certificates do not record theirs, and count.
    """
    path = certificate_path(runs.run_directory(settings))
    if not path.exists():
        return False
    recorded = store.read_json(path).get("certification")
    options = build.as_kwargs(settings["certification"], "renew")
    return recorded is None or not store.differences(recorded, options)
