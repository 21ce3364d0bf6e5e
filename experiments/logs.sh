#!/usr/bin/env bash
# From 20 minutes of logs of a car under its own driver, and 10 runs under a policy, to its corridor (docs/your-data.md). The car is the
# bicycle of highway-env. Extra arguments are Hydra overrides.
set -euo pipefail
export PYTHONPATH=${PYTHONPATH:-src}:.:tests/data root=${root:-runs/logs}
car() { python -c "import sys, numpy as np, sfkd_jax, recorded; from pathlib import Path; from tests.plants.simulators import highway
root, policy, car, box = Path('$root'), Path('$root/car/sfkd_path/seed=0'), highway(), ([0.35, -3], [1, 3]); $1"; }
names='t,p_x,p_y,yaw,v,v_y,yaw_rate,steering,acceleration,grip,push'
car "recorded.drive_by_hand(car, root / 'logs', box, range(1000, 1020), 60, '$names')"
python -m sfkd_jax.train +experiment=s3 name=car vehicle=logged vehicle.path="$root/logs" root="$root" vehicle.wheelbase=5 \
  'vehicle.columns.state=[p_x,p_y,yaw,v,v_y,yaw_rate]' 'vehicle.columns.environment=[grip,push]' dataset.segments=4000 \
  'dataset.speed=[8,11]' 'dataset.law.speed=[8,11]' 'dataset.law.points=[13,3,5]' certification.corridor.runs=40 \
  certification.corridor.duration=20 certification.corridor.attack_steps=20000 'evaluation.systems=[self]' "$@"
car "recorded.drive_under(sfkd_jax.load(policy), car, root / 'recorded', box, range(10), 60)"
python -m sfkd_jax.collect name=car root="$root" collect.path="$root/recorded" certification.level=0.9
car "recorded.drive_under(sfkd_jax.load(policy), car, root / 'further', box, range(100, 120), 60)"
python -m sfkd_jax.collect name=car root="$root" collect.path="$root/further"
