#!/usr/bin/env bash
# Rows of table1_closed_loop trained from three seeds, both plants, sampled around feedback.
# Finished cells are skipped, so the same command continues. Rows by comparison.only=[…], seeds by comparison.seeds=[…].
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" seeds "$@"
