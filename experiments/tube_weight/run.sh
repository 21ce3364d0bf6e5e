#!/usr/bin/env bash
# SFKD in path coordinates with four weights of the certified tube in its training loss, both plants, on S2, S3 (docs/results/path-frame.md).
# Finished cells are skipped, so the same command continues. The weight that ships is the policy of path_frame.
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" tube_weight "$@"
