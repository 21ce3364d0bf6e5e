#!/usr/bin/env bash
# Steady friction and wind that training drives had, that lie between theirs, and beyond: rows of table1_closed_loop with their policies.
# Rows by comparison.only=[…].
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" levels "$@"
