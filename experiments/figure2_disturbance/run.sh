#!/usr/bin/env bash
# The paper's Figure 2 for every row of table1_closed_loop, with its policies (trained now if they are missing).
set -euo pipefail
python -m sfkd_jax.compare +experiment=figure2 "$@"
