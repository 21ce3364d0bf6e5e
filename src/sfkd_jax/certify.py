"""python -m sfkd_jax.certify: recompute what can be proved about the weights of a run. Exit 0, 2 refused, 3 stale."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from sfkd_jax import artefacts, build, policy
from sfkd_jax.certification import (
    CertificateStale,
    CertificationRefused,
    certify_incremental,
    claims_a_rate,
    claims_of,
    issue,
)
from sfkd_jax.cli.config import door
from sfkd_jax.corridor import certify_corridor
from sfkd_jax.pipeline import stages, store

INCREMENTAL = "incremental.json"
"""A rate of a continuous flow lies apart: other doors take a certificate for one with
tubes and bounds of a monitor.
"""


def certificate_path(place: Path) -> Path:
    """Where what is proved of a run lies, or will lie."""
    flow = place / INCREMENTAL
    return flow if flow.exists() else place / policy.CERTIFICATE


def renew(settings: dict[str, Any]) -> dict[str, Any]:
    """Certify the policy of this run as it is now; a refusal is a document too."""
    began = time.perf_counter()
    place = store.run_directory(settings)
    trained = stages.ensure_policy(settings)
    flow = claims_a_rate(trained.model, trained.params)
    try:
        document = _rate(settings, trained) if flow else _tubes(settings, trained)
    except CertificationRefused as reason:
        document = {"valid": False, "reason": str(reason)}
    versions = artefacts.versions() | document.get("versions", {})
    document |= {
        "weights_sha256": trained.weights_sha256,
        "policy_sha256": trained.sha256,
        "versions": versions,
    }
    document["seconds"] = time.perf_counter() - began
    kept, other = (
        (INCREMENTAL, policy.CERTIFICATE) if flow else (policy.CERTIFICATE, INCREMENTAL)
    )
    (place / other).unlink(missing_ok=True)
    artefacts.write_json(place / kept, document)
    verdict = (
        f"alpha {document['alpha']:.6f}"
        if document["valid"]
        else f"refused: {document['reason']}"
    )
    if "d_bar" in document:
        verdict += f"; d_bar {document['d_bar']['value']:.4g} holds for {document['d_bar']['holds_for']}"
    artefacts.print_message(f"certificate: {verdict}")
    return document


def _rate(settings: dict[str, Any], trained: policy.TrainedModel) -> dict[str, Any]:
    """What is proved of a continuous flow: how fast it contracts, and no tube."""
    return certify_incremental(
        trained.model, trained.params, dt=settings["vehicle"]["dt"]
    )


def _tubes(settings: dict[str, Any], trained: policy.TrainedModel) -> dict[str, Any]:
    """What is proved of a model's steps, and what is measured on the data of the run."""
    dataset, _ = stages.ensure_dataset(settings)
    options = {
        name: value
        for name, value in settings["certification"].items()
        if name not in ("renew", "corridor")
    }
    boxes, noise = (
        store.boxes(dataset),
        tuple(settings["evaluation"]["observation_noise"]),
    )
    if store.is_logged(settings):  # the robot's own sensors are in its logs already
        boxes, noise = boxes | {"names": store.channel_names(settings)}, ()
    document = issue(
        trained.model,
        trained.params,
        validation=dataset.validation,
        calibration=dataset.calibration,
        held_out=stages.held_out_parts(settings, dataset),
        boxes=boxes,
        drives=dataset.drives,
        sensor_noise=noise,
        **build.as_kwargs(options),
    )
    if document["outputs"] and not store.is_logged(settings):
        asked = build.as_kwargs(settings["certification"]["corridor"])
        proved = claims_of(document["outputs"])
        document["corridor"] = certify_corridor(settings, trained, proved, **asked)
    return document


@store.exclusive
def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Certify, unless a certificate about other weights lies there (then `certification.renew=true`)."""
    trained = stages.ensure_policy(settings)
    place = store.run_directory(settings)
    path = certificate_path(place)
    if path.exists() and not settings["certification"]["renew"]:
        about = artefacts.read_json(path).get("policy_sha256")
        if about != trained.sha256:
            raise CertificateStale(
                f"{path} is about other weights or settings; certification.renew=true replaces it"
            )
    document = renew(settings)
    if not document["valid"]:
        raise CertificationRefused(document["reason"])
    keys = ("valid", "alpha", "alpha_separate", "rho", "beta", "tightness", "seconds")
    bound = document.get("d_bar", {"value": None})
    short = {
        "certificate": str(certificate_path(place)),
        "reason": None,
        "d_bar": bound["value"],
    }
    return short | {key: document.get(key) for key in keys}


if __name__ == "__main__":
    door(run)()
