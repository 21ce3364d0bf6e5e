#!/usr/bin/env bash
# The paper's Table 1 and Figure 1: every row, both plants, sampled around feedback and plain. Finished cells are
# skipped, so the same command continues. A night on an accelerator: run.sh evaluation=paper comparison.seeds=[0,1,2,3,4]
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" table1 "$@"
