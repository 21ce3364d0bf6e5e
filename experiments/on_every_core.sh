#!/usr/bin/env bash
# on_every_core.sh NAME [overrides]: python -m sfkd_jax.compare +experiment=NAME, a process per core, each held to its core:
# several times faster than one process on all of them. With an accelerator it is one process.
set -euo pipefail
name=$1 && shift
cores=$(command -v nvidia-smi >/dev/null && echo 1 || nproc)
if command -v taskset >/dev/null && [ "$cores" -gt 1 ]; then
  case $name in protocol2*) vehicles="kinematic kinematic_stiff dynamic" ;; *) vehicles="kinematic dynamic" ;; esac
  for vehicle in $vehicles; do python -m sfkd_jax.generate "+experiment=$name" vehicle="$vehicle" "$@"; done
  for ((core = 0; core < cores; core++)); do
    taskset -c "$core" python -m sfkd_jax.compare "+experiment=$name" "comparison.share=[$core,$cores]" "$@" &
  done
  wait
fi
python -m sfkd_jax.compare "+experiment=$name" "$@"
