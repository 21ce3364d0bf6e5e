#!/usr/bin/env bash
# SFKD with the paper's latent cost, and trained at the paper's fixed levels, both plants, on S2, S3 (docs/results/paper-comparison.md).
# Finished cells are skipped, so the same command continues.
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" paper_terms "$@"
