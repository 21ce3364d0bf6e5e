"""The certificate of a policy as a typed tree, and its file."""

from sfkd_jax.certificate._document import FORMAT as FORMAT
from sfkd_jax.certificate._document import Certificate as Certificate
from sfkd_jax.certificate._document import Provenance as Provenance
from sfkd_jax.certificate._document import Refusal as Refusal
from sfkd_jax.certificate._document import parse as parse
from sfkd_jax.certificate._document import read as read
from sfkd_jax.certificate._document import signature_of as signature_of
from sfkd_jax.certificate._document import write as write
from sfkd_jax.certificate._measured import AxisNames as AxisNames
from sfkd_jax.certificate._measured import Boxes as Boxes
from sfkd_jax.certificate._measured import Coverage as Coverage
from sfkd_jax.certificate._measured import Measured as Measured
from sfkd_jax.certificate._measured import OutputBound as OutputBound
from sfkd_jax.certificate._measured import OutputTube as OutputTube
from sfkd_jax.certificate._measured import StepBounds as StepBounds
from sfkd_jax.certificate._measured import StepErrors as StepErrors
from sfkd_jax.certificate._measured import Tube as Tube
from sfkd_jax.certificate._proof import Box as Box
from sfkd_jax.certificate._proof import Claims as Claims
from sfkd_jax.certificate._proof import LyapunovClaim as LyapunovClaim
from sfkd_jax.certificate._proof import Matrix as Matrix
from sfkd_jax.certificate._proof import Multipliers as Multipliers
from sfkd_jax.certificate._proof import OutputMetric as OutputMetric
from sfkd_jax.certificate._proof import Proof as Proof
from sfkd_jax.certificate._proof import Row as Row
from sfkd_jax.certificate._proof import Witnesses as Witnesses
from sfkd_jax.certificate._signature import Signature as Signature
from sfkd_jax.certificate._signature import can_check as can_check
from sfkd_jax.certificate._signature import describe_signature as describe_signature
from sfkd_jax.certificate._signature import is_signed as is_signed
from sfkd_jax.certificate._signature import private_key as private_key
from sfkd_jax.certificate._signature import public_key_of as public_key_of

# isort: split
# Of a policy that drives:
from sfkd_jax.certificate._corridor import Bounds as Bounds
from sfkd_jax.certificate._corridor import Conditions as Conditions
from sfkd_jax.certificate._corridor import Corridor as Corridor
from sfkd_jax.certificate._corridor import CorridorAttack as CorridorAttack
from sfkd_jax.certificate._corridor import GroupBounds as GroupBounds
from sfkd_jax.certificate._corridor import Innovations as Innovations
from sfkd_jax.certificate._corridor import JointBounds as JointBounds
from sfkd_jax.certificate._corridor import Recorded as Recorded
from sfkd_jax.certificate._corridor import RecordedConditions as RecordedConditions
from sfkd_jax.certificate._corridor import Seen as Seen
from sfkd_jax.certificate._driving import DrivingCertificate as DrivingCertificate
