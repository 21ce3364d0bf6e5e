#!/usr/bin/env bash
# What the paper lacks: e told late, noisy or biased, and worse sensors, on S3, with the policies of table1_closed_loop.
# Rows by comparison.only=[…].
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" robustness "$@"
