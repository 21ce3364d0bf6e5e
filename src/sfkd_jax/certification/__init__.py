"""Certificates: bounds proved for all inputs, and measured disturbance bounds.

`sfkd_jax.certification.corridor` calibrates and attacks the corridor of a closed loop.
"""

from sfkd_jax.certification._attack import (
    CertificateContradicted as CertificateContradicted,
)
from sfkd_jax.certification._certificate import Certificate as Certificate
from sfkd_jax.certification._certificate import certify as certify
from sfkd_jax.certification._certificate import issue as issue
from sfkd_jax.certification._certificate import verify as verify
from sfkd_jax.certification._core import check_metric as check_metric
from sfkd_jax.certification._core import check_vertices as check_vertices
from sfkd_jax.certification._core import check_witness as check_witness
from sfkd_jax.certification._core import is_positive_definite as is_positive_definite
from sfkd_jax.certification._core import norm_upper as norm_upper
from sfkd_jax.certification._metric_claims import (
    OutputMetric as OutputMetric,
)
from sfkd_jax.certification._search import lipschitz_upper as lipschitz_upper
from sfkd_jax.certification._tubes import latent_tube as latent_tube
from sfkd_jax.certification._verification import verify_document as verify_document
from sfkd_jax.certification._weights import CertificateStale as CertificateStale
from sfkd_jax.certification._weights import CertificationRefused as CertificationRefused
