#!/usr/bin/env bash
# Runs a comparison with one process for each core, each held to its core:
#
#     bash experiments/on_every_core.sh NAME [Hydra overrides]
#
# It is `python -m sfkd_jax.compare +experiment=NAME`, several times faster than one process on all cores. With an
# accelerator it is one process.
set -euo pipefail
name=$1 && shift
cores=()
if command -v taskset >/dev/null && ! command -v nvidia-smi >/dev/null; then
  read -ra cores <<<"$(python -c 'import os; print(*sorted(os.sched_getaffinity(0)))')"
fi
if [ "${#cores[@]}" -gt 1 ]; then
  case $name in benchmark*) vehicles="kinematic kinematic_stiff dynamic" ;; *) vehicles="kinematic dynamic" ;; esac
  for vehicle in $vehicles; do python -m sfkd_jax.generate "+experiment=$name" vehicle="$vehicle" "$@"; done
  shares=()
  # Jobs in the background ignore Ctrl-C, so that they would go on alone.
  trap 'kill $(jobs -p) 2>/dev/null; wait; exit 130' INT TERM
  for number in "${!cores[@]}"; do
    taskset -c "${cores[number]}" python -m sfkd_jax.compare "+experiment=$name" "comparison.share=[$number,${#cores[@]}]" "$@" &
    shares+=($!)
  done
  failed=0
  for share in "${shares[@]}"; do wait "$share" || failed=1; done
  trap - INT TERM
  [ "$failed" = 0 ] || { echo "a process failed; the same command continues" >&2 && exit 1; }
fi
python -m sfkd_jax.compare "+experiment=$name" "$@"
