"""Certification: `prove` bounds for all inputs, `measure` disturbances, and `verify`.

`sfkd_jax.certification.corridor` calibrates and attacks the corridor of a closed loop.
"""

from sfkd_jax.certification._attack import (
    CertificateContradicted as CertificateContradicted,
)
from sfkd_jax.certification._core import check_metric as check_metric
from sfkd_jax.certification._core import check_vertices as check_vertices
from sfkd_jax.certification._core import check_witness as check_witness
from sfkd_jax.certification._core import is_positive_definite as is_positive_definite
from sfkd_jax.certification._core import norm_upper as norm_upper
from sfkd_jax.certification._measuring import boxes_of as boxes_of
from sfkd_jax.certification._measuring import measure as measure
from sfkd_jax.certification._proving import prove as prove
from sfkd_jax.certification._proving import verify_proof as verify_proof
from sfkd_jax.certification._search import lipschitz_upper as lipschitz_upper
from sfkd_jax.certification._tubes import latent_tube as latent_tube
from sfkd_jax.certification._verification import verify as verify
from sfkd_jax.certification._weights import CertificateStale as CertificateStale
from sfkd_jax.certification._weights import CertificationRefused as CertificationRefused

# isort: split
# Of a policy that drives:
from sfkd_jax.certification._corridor_verification import (
    verify_driving as verify_driving,
)
