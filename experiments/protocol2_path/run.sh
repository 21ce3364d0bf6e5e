#!/usr/bin/env bash
# sfkd-bench-2 in path coordinates: every model around one law, three plants, three trainings, 16 episodes (docs/results/protocol-2.md).
# Finished cells are skipped, so the same command continues. Rows by comparison.only=[…].
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" protocol2_path "$@"
