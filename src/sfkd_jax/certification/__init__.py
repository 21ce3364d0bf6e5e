"""Certification: `prove` bounds for all inputs, `measure` errors, and `verify`."""

from sfkd_jax.certification._attack import (
    CertificateContradicted as CertificateContradicted,
)
from sfkd_jax.certification._claims import readouts as readouts
from sfkd_jax.certification._claims import rows as rows
from sfkd_jax.certification._core import check_metric as check_metric
from sfkd_jax.certification._core import check_vertices as check_vertices
from sfkd_jax.certification._core import check_witness as check_witness
from sfkd_jax.certification._core import is_positive_definite as is_positive_definite
from sfkd_jax.certification._core import norm_upper as norm_upper
from sfkd_jax.certification._measured import alarm_thresholds as alarm_thresholds
from sfkd_jax.certification._measured import check_count as check_count
from sfkd_jax.certification._measured import conformal_bounds as conformal_bounds
from sfkd_jax.certification._measured import conformal_quantile as conformal_quantile
from sfkd_jax.certification._measured import coverage as coverage
from sfkd_jax.certification._measured import residuals as residuals
from sfkd_jax.certification._measuring import boxes_of as boxes_of
from sfkd_jax.certification._measuring import measure as measure
from sfkd_jax.certification._proving import prove as prove
from sfkd_jax.certification._proving import verify_proof as verify_proof
from sfkd_jax.certification._search import lipschitz_upper as lipschitz_upper
from sfkd_jax.certification._tubes import FORMS as FORMS
from sfkd_jax.certification._tubes import latent_tube as latent_tube
from sfkd_jax.certification._tubes import radii as radii
from sfkd_jax.certification._verification import REPEATED as REPEATED
from sfkd_jax.certification._verification import Trained as Trained
from sfkd_jax.certification._verification import near as near
from sfkd_jax.certification._verification import verify as verify
from sfkd_jax.certification._weights import CertificateStale as CertificateStale
from sfkd_jax.certification._weights import CertificationRefused as CertificationRefused
from sfkd_jax.certification._weights import exported as exported
from sfkd_jax.certification._weights import require as require
from sfkd_jax.certification._weights import well_formed as well_formed
