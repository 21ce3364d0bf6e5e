#!/usr/bin/env bash
# What a certified rate costs: α against prediction, tracking and tubes, for both control conventions; then β at one α.
# Finished runs are skipped, so the same command continues.
set -euo pipefail
root=runs
for argument in "$@"; do case $argument in root=*) root=${argument#root=} ;; esac; done

drive() { # vehicle, alpha, beta
  local name="contraction/$1_alpha=$2_beta=$3"
  if [ ! -e "$root/$name/sfkd/seed=0/results.json" ]; then
    local rho
    rho=$(python -c "print(round($2 - $3, 6))")
    python -m sfkd_jax.train +experiment=contraction vehicle="$1" "name='$name'" model.rho="$rho" model.beta="$3" "${@:4}"
  fi
}

for alpha in 0.93 0.995 0.9 0.97; do drive kinematic_speed "$alpha" 0.05 "$@"; done
for alpha in 0.93 0.97 0.995; do drive kinematic "$alpha" 0.05 "$@"; done
for beta in 0.02 0.1; do drive kinematic_speed 0.93 "$beta" "$@"; done
python -m sfkd_jax.report +experiment=contraction "report.compare='contraction/*/*/seed=*'" "$@"
