"""The certificate of a policy that drives along a path."""

from sfkd_jax.driving.certificate._certificate import (
    DrivingCertificate as DrivingCertificate,
)
from sfkd_jax.driving.certificate._corridor import Bounds as Bounds
from sfkd_jax.driving.certificate._corridor import Conditions as Conditions
from sfkd_jax.driving.certificate._corridor import Corridor as Corridor
from sfkd_jax.driving.certificate._corridor import CorridorAttack as CorridorAttack
from sfkd_jax.driving.certificate._corridor import GroupBounds as GroupBounds
from sfkd_jax.driving.certificate._corridor import Innovations as Innovations
from sfkd_jax.driving.certificate._corridor import JointBounds as JointBounds
from sfkd_jax.driving.certificate._corridor import LateCorridor as LateCorridor
from sfkd_jax.driving.certificate._corridor import LawMargins as LawMargins
from sfkd_jax.driving.certificate._corridor import Recorded as Recorded
from sfkd_jax.driving.certificate._corridor import (
    RecordedConditions as RecordedConditions,
)
from sfkd_jax.driving.certificate._corridor import Seen as Seen
