#!/usr/bin/env bash
# CommonRoad's drift car along a path: a law from its own step, its drives, a model of them, certified with its corridor; then
# drives of the car by the package's own functions, and docs/results/other-cars.md. Needs the extra `plants`. Environment: ROOT, for the runs
# (default runs). Extra arguments are Hydra overrides.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
export PYTHONPATH="benchmarks${PYTHONPATH:+:$PYTHONPATH}"
python -m sfkd_jax.certify +experiment=s3 vehicle=own vehicle.step=commonroad_traced:step name=commonroad_path \
  vehicle.state_names='[p_x,p_y,yaw,v,v_y,yaw_rate,steering,hidden_7,hidden_8]' vehicle.wheelbase=2.5789 \
  vehicle.wind_force=10.0 vehicle.control_low='[-0.5,-6.0]' vehicle.control_high='[0.5,3.0]' dataset.law.points='[9,3,5]' \
  dataset.law.lateral_acceleration=1.9 dataset.lateral_acceleration=1.7 dataset.segments=4000 training.steps=3000 training.batch=64 \
  certification.corridor.attack_steps=50000 root="${ROOT:-runs}" "$@"
python -m experiments.commonroad.path --root "${ROOT:-runs}"
python -m experiments.commonroad.page --write
