"""Certificates: bounds proved for all inputs, and measured disturbance bounds."""

from sfkd_jax.certification._attack import attack_decoder as attack_decoder
from sfkd_jax.certification._attack import attack_slopes as attack_slopes
from sfkd_jax.certification._attack import attack_step as attack_step
from sfkd_jax.certification._attack import attack_transport as attack_transport
from sfkd_jax.certification._attack_all import (
    CertificateContradicted as CertificateContradicted,
)
from sfkd_jax.certification._calibration import Disturbance as Disturbance
from sfkd_jax.certification._calibration import clopper_pearson as clopper_pearson
from sfkd_jax.certification._calibration import conformal_bounds as conformal_bounds
from sfkd_jax.certification._calibration import coverage as coverage
from sfkd_jax.certification._calibration import coverage_interval as coverage_interval
from sfkd_jax.certification._calibration import disturbances as disturbances
from sfkd_jax.certification._calibration import monitor_units as monitor_units
from sfkd_jax.certification._calibration import tube_units as tube_units
from sfkd_jax.certification._certificate import MODES as MODES
from sfkd_jax.certification._certificate import Certificate as Certificate
from sfkd_jax.certification._certificate import CertificateStale as CertificateStale
from sfkd_jax.certification._certificate import certify as certify
from sfkd_jax.certification._certificate import verify as verify
from sfkd_jax.certification._conformal_tube import conformal_tube as conformal_tube
from sfkd_jax.certification._core import check_metric as check_metric
from sfkd_jax.certification._core import check_vertices as check_vertices
from sfkd_jax.certification._core import check_witness as check_witness
from sfkd_jax.certification._core import is_positive_definite as is_positive_definite
from sfkd_jax.certification._core import norm_upper as norm_upper
from sfkd_jax.certification._corridor_claims import DriveScores as DriveScores
from sfkd_jax.certification._corridor_claims import (
    calibrate_corridor as calibrate_corridor,
)
from sfkd_jax.certification._corridor_claims import (
    corridor_coverage as corridor_coverage,
)
from sfkd_jax.certification._corridor_claims import drive_scores as drive_scores
from sfkd_jax.certification._document import verify_document as verify_document
from sfkd_jax.certification._environments import bound_over_box as bound_over_box
from sfkd_jax.certification._exported import (
    CertificationRefused as CertificationRefused,
)
from sfkd_jax.certification._fixed_points import FixedPoints as FixedPoints
from sfkd_jax.certification._fixed_points import (
    fixed_point_corridor as fixed_point_corridor,
)
from sfkd_jax.certification._fixed_points import fixed_points as fixed_points
from sfkd_jax.certification._incremental import attack_growth as attack_growth
from sfkd_jax.certification._incremental import (
    certify_incremental as certify_incremental,
)
from sfkd_jax.certification._incremental import check_incremental as check_incremental
from sfkd_jax.certification._incremental import incremental_rate as incremental_rate
from sfkd_jax.certification._incremental import is_incremental as is_incremental
from sfkd_jax.certification._issue import contraction_metrics as contraction_metrics
from sfkd_jax.certification._issue import issue as issue
from sfkd_jax.certification._output_metrics import OUTPUTS as OUTPUTS
from sfkd_jax.certification._output_metrics import OutputMetric as OutputMetric
from sfkd_jax.certification._output_tubes import (
    output_metrics_from as output_metrics_from,
)
from sfkd_jax.certification._proposals import lipschitz_upper as lipschitz_upper
from sfkd_jax.certification._proposals import propose_multipliers as propose_multipliers
from sfkd_jax.certification._radii import radii as radii
from sfkd_jax.certification._radii import residuals as residuals
from sfkd_jax.certification._solvers import solve_metric as solve_metric
from sfkd_jax.certification._solvers import solve_multipliers as solve_multipliers
from sfkd_jax.certification._tube import latent_tube as latent_tube
from sfkd_jax.certification._tube import physical_tube as physical_tube
