#!/usr/bin/env bash
# Every kinematic row of table1_closed_loop on S3, trained again on 10 % and on 1 % of the same data: two trainings a row.
set -euo pipefail
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" small_data "$@"
