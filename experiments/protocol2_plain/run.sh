#!/usr/bin/env bash
# sfkd-bench-2 with the paper's plain sampling: SFKD and the oracle on S3, three plants, with the policies of protocol2 (docs/results/protocol-2.md).
# Finished cells are skipped, so the same command continues; comparison.seeds=[0,1,2] adds the other trainings.
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" protocol2_plain 'comparison.seeds=[0]' "$@"
