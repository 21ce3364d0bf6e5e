#!/usr/bin/env bash
# sfkd-bench-2 in the body frame: every row on three plants, one training of three, 16 episodes (docs/results/protocol-2.md).
# Finished cells are skipped, so the same command continues; comparison.seeds=[0,1,2] adds the other trainings.
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" protocol2 'comparison.seeds=[0]' "$@"
