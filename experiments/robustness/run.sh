#!/usr/bin/env bash
# What the paper lacks: e measured late, noisy or biased, worse sensors, unseen levels, small training sets; the rows of
# table1_closed_loop, with its policies.
set -euo pipefail
for study in robustness levels small_data; do
  python -m sfkd_jax.compare +experiment="$study" "$@"
done
