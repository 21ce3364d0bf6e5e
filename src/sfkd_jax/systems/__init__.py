"""Systems of the user: their coordinates, laws, closed loops, runs and shields."""

from sfkd_jax.systems._certificate import LoopConditions as LoopConditions
from sfkd_jax.systems._certificate import LoopTubes as LoopTubes
from sfkd_jax.systems._certificate import OutputBounds as OutputBounds
from sfkd_jax.systems._certificate import SystemCertificate as SystemCertificate
from sfkd_jax.systems._closed_loop import ClosedLoop as ClosedLoop
from sfkd_jax.systems._controller import Following as Following
from sfkd_jax.systems._law import Law as Law
from sfkd_jax.systems._law import NoLaw as NoLaw
from sfkd_jax.systems._law import SteadyState as SteadyState
from sfkd_jax.systems._law import derive_law as derive_law
from sfkd_jax.systems._runs import Reference as Reference
from sfkd_jax.systems._runs import random_reference as random_reference
from sfkd_jax.systems._runs import random_runs as random_runs
from sfkd_jax.systems._runs import spread_of as spread_of
from sfkd_jax.systems._shield import OutputBound as OutputBound
from sfkd_jax.systems._shield import Shield as Shield
from sfkd_jax.systems._system import System as System
from sfkd_jax.systems._system import integrated as integrated
from sfkd_jax.systems._task import TrackingTask as TrackingTask
from sfkd_jax.systems._task import tracking_task as tracking_task
from sfkd_jax.systems._tracking import Tracked as Tracked
from sfkd_jax.systems._tracking import Tracking as Tracking
from sfkd_jax.systems._tracking import regulation as regulation
from sfkd_jax.systems._tracking import tracking as tracking
