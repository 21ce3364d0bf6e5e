"""Names of the files that a policy consists of, in its run directory."""

from sfkd_jax import store

POLICY_FILE = f"policy{store.SUFFIX}"
"""Weights, law and settings of a vehicle."""
SYSTEM_FILE = f"system{store.SUFFIX}"
"""The same of a system."""
CERTIFICATE = "certificate.json"
"""The certificate in a run directory."""
RECORDED = "certificate.runs.json"
"""The certificate with the corridor of recorded runs; it is read in place of the other
where both exist.
"""
FILES = (POLICY_FILE, SYSTEM_FILE, CERTIFICATE, RECORDED)
"""All that `load` reads; no policy has all of them."""
