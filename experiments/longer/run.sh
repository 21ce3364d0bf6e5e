#!/usr/bin/env bash
# SFKD with and without its bound, dynamic plant, with twice the training steps and with a rate nearer to 1: whether their
# difference is want of training, or of the rate.
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" longer "$@"
