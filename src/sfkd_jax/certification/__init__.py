"""The notary: what is claimed for all states, controls and environments, and what is only measured."""

from sfkd_jax.certification._calibration import clopper_pearson as clopper_pearson
from sfkd_jax.certification._calibration import conformal_bounds as conformal_bounds
from sfkd_jax.certification._calibration import coverage as coverage
from sfkd_jax.certification._calibration import disturbances as disturbances
from sfkd_jax.certification._certificate import CertificationRefused as CertificationRefused
from sfkd_jax.certification._certificate import certify as certify
from sfkd_jax.certification._certificate import contraction as contraction
from sfkd_jax.certification._core import check_witness as check_witness
from sfkd_jax.certification._core import is_positive_definite as is_positive_definite
from sfkd_jax.certification._core import norm_upper as norm_upper
from sfkd_jax.certification._lipschitz import lipschitz_upper as lipschitz_upper
from sfkd_jax.certification._tube import latent_tube as latent_tube
from sfkd_jax.certification._tube import physical_tube as physical_tube
