#!/usr/bin/env bash
# Twice the training steps for SFKD with and without its bound, dynamic plant: what of their difference is want of training.
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" longer "$@"
