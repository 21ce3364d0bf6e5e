#!/usr/bin/env bash
# The paper's Figure 2 for every row of table1_closed_loop, with its policies (trained now if they are missing).
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" figure2 "$@"
