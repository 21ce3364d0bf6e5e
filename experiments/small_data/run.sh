#!/usr/bin/env bash
# Rows of table1_closed_loop on S3, trained again on 10 % and on 1 % of the same data.
# Two trainings a row; every learned row of the table by comparison.only=[].
set -euo pipefail
rows=koopman_mpc,sfkd,sfkd_no_fiber,sfkd_no_contraction,neural_ode,icode,control_synth,r2dn
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" small_data "comparison.only=[$rows]" "$@"
