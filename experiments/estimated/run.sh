#!/usr/bin/env bash
# SFKD where friction and wind are inferred while driving, beside the measured ones, on S2 and S3 and both plants (docs/estimation.md).
# It drives the policies of table1_closed_loop and trains them first if they do not lie there.
set -euo pipefail
python -m sfkd_jax.compare +experiment=estimated "$@"
