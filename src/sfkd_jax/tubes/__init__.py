"""Tubes of the closed loop of a system: measured on runs, proved, and verified."""

from sfkd_jax.tubes._measuring import measure_tubes as measure_tubes
from sfkd_jax.tubes._one_step import OneStep as OneStep
from sfkd_jax.tubes._one_step import States as States
from sfkd_jax.tubes._verification import verify_system as verify_system
from sfkd_jax.tubes._worst_case import WorstCase as WorstCase
from sfkd_jax.tubes._worst_case import WorstCaseRefused as WorstCaseRefused
from sfkd_jax.tubes._worst_case import check_worst_case as check_worst_case
from sfkd_jax.tubes._worst_case import prove_worst_case as prove_worst_case
from sfkd_jax.tubes._worst_case import sampled_worst as sampled_worst
