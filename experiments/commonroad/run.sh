#!/usr/bin/env bash
# CommonRoad's single-track drift and multi-body cars on three frictions: the shipped policies, nominal-MPPI, and the same
# policies after training on from 200 drives of the drift car; then docs/results/other-cars.md. Needs the extra `plants`.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
python -m experiments.commonroad.train "$@"
python -m experiments.commonroad.page --write
