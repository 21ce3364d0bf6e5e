"""Verification of certificates from an untrusted source, without any search.

`schema` gives every entry of a document one of three rules. The trusted core checks
proved entries. Entries that follow are derived again from the policy and other entries.
Measured entries lie in a range that the policy and other entries leave, within which
only a signature could bind them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sfkd_jax.certification._certificate import Certificate, verify
from sfkd_jax.certification._corridor_schema import corridor_rules, recorded_rules
from sfkd_jax.certification._metric_claims import (
    OutputMetric,
    require_lyapunov,
    require_output_metric,
)
from sfkd_jax.certification._rules import require_entry
from sfkd_jax.certification._schema import (
    Trained,
    document_rules,
    is_simulated,
    settings_rules,
)
from sfkd_jax.certification._weights import (
    CertificateStale,
    Exported,
    exported,
    one_thread,
    require,
    well_formed,
)


def verify_document(document: Mapping[str, Any], trained: Trained) -> None:
    """Check a document from an untrusted source against a policy, without any search.

    Args:
        document: from `certify`.
        trained: the policy. The hash in the document is about its settings, too.

    Raises:
        CertificateStale: it is about other weights or settings.
        CertificationRefused: it does not hold; gives the reason.
    """
    # `is not True`, because the text "false" or a number must not pass.
    require(document.get("valid") is True, str(document.get("reason")))
    # The same weights under another controller are another policy. The hash therefore
    # covers the settings, too.
    if document.get("policy_sha256") != trained.sha256:
        raise CertificateStale("the certificate is about other weights or settings")
    weights = exported(trained.model, trained.params)
    with well_formed(), np.errstate(all="ignore"):
        require_entry("", document, schema(document, trained, weights))
    # From here on all entries have the types that they should have.
    proof = Certificate.from_document(document)
    verify(proof, trained.params, model=trained.model, weights=weights)
    with well_formed(), one_thread():
        require_lyapunov(document["lyapunov"], weights)
        for name, part in document["outputs"].items():
            require_output_metric(name, OutputMetric.from_document(part), weights)


def schema(
    document: Mapping[str, Any], trained: Trained, weights: Exported
) -> dict[str, Any]:
    """Return the rule of every entry that a document about this policy must have.

    Entries without a rule are refused.

    Args:
        document: the certificate.
        trained: the policy.
        weights: its explicit weights.
    """
    rules = document_rules(document, trained, weights)
    if document["outputs"] != {}:
        # Logs have no plant that could be driven, and no corridor.
        if is_simulated(trained):
            rules["corridor"] = corridor_rules(document, trained)
        if "recorded" in document:
            rules["recorded"] = recorded_rules(document)
    # A certificate that no command has made states no settings of one.
    if "certification" in document:
        rules["certification"] = settings_rules(document)
    return rules
