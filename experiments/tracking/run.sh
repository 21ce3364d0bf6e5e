#!/usr/bin/env bash
# One trained policy on S3, then the same policy on S1 and S2, then the report. Operator and residual have a budget each.
set -euo pipefail
set -- model.budget=sum model.linear_lift=false training.loss.consistency=0.1 name=tracking "$@"
python -m sfkd_jax.train +experiment=s3_body "$@"
for scenario in s1 s2; do
  python -m sfkd_jax.evaluate +experiment=s3_body scenario="$scenario" "$@"
done
python -m sfkd_jax.report +experiment=s3_body "$@"
