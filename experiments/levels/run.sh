#!/usr/bin/env bash
# Steady friction and wind that training drives had, that lie between theirs, and beyond: rows of table1_closed_loop with their policies.
# Rows by comparison.only=[…].
set -euo pipefail
python -m sfkd_jax.compare +experiment=levels "$@"
