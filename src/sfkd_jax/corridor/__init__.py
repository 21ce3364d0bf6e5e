"""The corridor of a policy along a path: what its drives bound, an attack on it, and what it says about speed."""

from sfkd_jax.corridor._certify import certify_corridor as certify_corridor
from sfkd_jax.corridor._speed import corridor_by_speed as corridor_by_speed
from sfkd_jax.corridor._speed import fastest as fastest
