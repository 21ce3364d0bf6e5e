#!/usr/bin/env bash
# Every model in path coordinates around one law, both plants, on S1, S2, S3 without a shield (docs/results/path-frame.md).
# Finished cells are skipped, so the same command continues. Rows by comparison.only=[…].
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" path_frame "$@"
