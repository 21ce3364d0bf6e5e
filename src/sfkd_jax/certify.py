"""python -m sfkd_jax.certify: recompute what can be proved about the weights of a run. Exit 0, 2 refused, 3 stale."""

from __future__ import annotations

import time
from typing import Any

from sfkd_jax import artefacts, assembly, policy, shelf, walk
from sfkd_jax.certification import CertificateStale, CertificationRefused, issue
from sfkd_jax.config import door


def renew(settings: dict[str, Any]) -> dict[str, Any]:
    """Certify the policy of this run as it is now; a refusal is a document too."""
    began = time.perf_counter()
    place = shelf.run_directory(settings)
    trained = walk.ensure_policy(settings)
    weights = policy.weights_hash(place)
    dataset, _ = walk.ensure_dataset(settings)
    options = {name: value for name, value in settings["certification"].items() if name != "renew"}
    try:
        document = issue(
            trained.model,
            trained.params,
            validation=dataset.validation,
            calibration=dataset.calibration,
            held_out=walk.held_out_drives(settings, dataset),
            boxes=shelf.boxes(dataset),
            sensor_noise=tuple(settings["evaluation"]["observation_noise"]),
            **assembly.without(options),
        )
    except CertificationRefused as reason:
        document = {"valid": False, "reason": str(reason)}
    versions = artefacts.versions() | document.get("versions", {})
    document |= {"weights_sha256": weights, "versions": versions}
    document["seconds"] = time.perf_counter() - began
    artefacts.write_json(place / "certificate.json", document)
    verdict = f"alpha {document['alpha']:.6f}" if document["valid"] else f"refused: {document['reason']}"
    shelf.say(f"certificate: {verdict}")
    return document


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Certify, unless a certificate about other weights lies there (then `certification.renew=true`)."""
    walk.ensure_policy(settings)
    place = shelf.run_directory(settings)
    path = place / "certificate.json"
    if path.exists() and not settings["certification"]["renew"]:
        about = artefacts.read_json(path, keys=("weights_sha256",))["weights_sha256"]
        if about != policy.weights_hash(place):
            raise CertificateStale(f"{path} is about other weights; certification.renew=true replaces it")
    document = renew(settings)
    if not document["valid"]:
        raise CertificationRefused(document["reason"])
    keys = ("valid", "alpha", "alpha_separate", "rho", "beta", "tightness", "seconds")
    short = {"certificate": str(path), "reason": None, "d_bar": document["d_bar"]["value"]}
    return short | {key: document[key] for key in keys}


if __name__ == "__main__":
    door(run)()
