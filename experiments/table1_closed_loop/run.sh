#!/usr/bin/env bash
# The paper's Table 1 and Figure 1: every row, both plants, sampled around feedback and plain. Finished cells are
# skipped, so the same command continues. A night on an accelerator: run.sh evaluation=paper comparison.seeds=[0,1,2,3,4]
# Without one, a process per core, each held to its core, is several times faster than one process on all of them.
set -euo pipefail
cores=$(command -v nvidia-smi >/dev/null && echo 1 || nproc)
if command -v taskset >/dev/null && [ "$cores" -gt 1 ]; then
  for vehicle in kinematic dynamic; do python -m sfkd_jax.generate vehicle="$vehicle" "$@"; done
  for ((core = 0; core < cores; core++)); do
    taskset -c "$core" python -m sfkd_jax.compare +experiment=table1 "comparison.share=[$core,$cores]" "$@" &
  done
  wait
fi
python -m sfkd_jax.compare +experiment=table1 "$@"
