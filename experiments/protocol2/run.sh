#!/usr/bin/env bash
# sfkd-bench-2 in the body frame: every row on three plants, 16 episodes; SFKD with and without its bound is trained three times
# (docs/results/protocol-2.md). Finished cells are skipped, so the same command continues; without the last three names of the list
# it is the whole protocol.
set -euo pipefail
once=sfkd_no_fiber,sfkd_no_transport,sfkd_no_residual,sfkd_soft,koopman_mpc,icode,control_synth,r2dn
once+=,icode_mppi,icode_mppi_reads_env,icode_mppi_one_step,neural_ode,icode_extrinsic,icode_mppi_extrinsic
bash "$(dirname "${BASH_SOURCE[0]}")/../on_every_core.sh" protocol2 "comparison.trained_once=[$once]" "$@"
