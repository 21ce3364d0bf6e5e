#!/usr/bin/env bash
# The rows that need no learning, on every scenario of the benchmark.
set -euo pipefail
for scenario in s1 s2 s3; do
  python -m sfkd_jax.evaluate +experiment=calibration scenario="$scenario" "$@"
done
