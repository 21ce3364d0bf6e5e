#!/usr/bin/env bash
# What the paper lacks: e told late, noisy or biased, and worse sensors, on S3, with the policies of table1_closed_loop.
# Rows by comparison.only=[…].
set -euo pipefail
python -m sfkd_jax.compare +experiment=robustness "$@"
