#!/usr/bin/env bash
# One certified policy on S3, driven again under side forces that neither it nor any model is told of; Figure 2.
set -euo pipefail
set -- model.budget=sum model.linear_lift=false training.loss.consistency=0.1 name=tracking "$@"  # the policy of experiments/tracking
python -m sfkd_jax.certify +experiment=s3_body "$@"
python -m sfkd_jax.evaluate +experiment=s3_body 'evaluation.side_forces=[0,250,500,1000]' "$@"
python -m sfkd_jax.report +experiment=s3_body "$@"
