"""Certificates: bounds proved for all inputs, and measured disturbance bounds.

`sfkd_jax.certification.corridor` calibrates and attacks the corridor of a closed loop.
"""

from sfkd_jax.certification._attack import (
    CertificateContradicted as CertificateContradicted,
)
from sfkd_jax.certification._attack import attack_decoder as attack_decoder
from sfkd_jax.certification._attack import attack_slopes as attack_slopes
from sfkd_jax.certification._attack import attack_step as attack_step
from sfkd_jax.certification._attack import attack_transport as attack_transport
from sfkd_jax.certification._calibration import clopper_pearson as clopper_pearson
from sfkd_jax.certification._calibration import conformal_bounds as conformal_bounds
from sfkd_jax.certification._calibration import coverage as coverage
from sfkd_jax.certification._calibration import coverage_interval as coverage_interval
from sfkd_jax.certification._calibration import disturbances as disturbances
from sfkd_jax.certification._calibration import tube_units as tube_units
from sfkd_jax.certification._certificate import Certificate as Certificate
from sfkd_jax.certification._certificate import CertificateStale as CertificateStale
from sfkd_jax.certification._certificate import certify as certify
from sfkd_jax.certification._certificate import (
    contraction_metrics as contraction_metrics,
)
from sfkd_jax.certification._certificate import verify as verify
from sfkd_jax.certification._claims import OUTPUTS as OUTPUTS
from sfkd_jax.certification._claims import LyapunovClaim as LyapunovClaim
from sfkd_jax.certification._claims import OutputMetric as OutputMetric
from sfkd_jax.certification._core import check_metric as check_metric
from sfkd_jax.certification._core import check_vertices as check_vertices
from sfkd_jax.certification._core import check_witness as check_witness
from sfkd_jax.certification._core import is_positive_definite as is_positive_definite
from sfkd_jax.certification._core import norm_upper as norm_upper
from sfkd_jax.certification._document import issue as issue
from sfkd_jax.certification._document import output_metrics_from as output_metrics_from
from sfkd_jax.certification._document import verify_document as verify_document
from sfkd_jax.certification._lyapunov import prove_lyapunov as prove_lyapunov
from sfkd_jax.certification._lyapunov import solve_metric as solve_metric
from sfkd_jax.certification._search import lipschitz_upper as lipschitz_upper
from sfkd_jax.certification._search import propose_multipliers as propose_multipliers
from sfkd_jax.certification._tubes import latent_tube as latent_tube
from sfkd_jax.certification._tubes import physical_tube as physical_tube
from sfkd_jax.certification._tubes import radii as radii
from sfkd_jax.certification._tubes import residuals as residuals
from sfkd_jax.certification._weights import CertificationRefused as CertificationRefused
