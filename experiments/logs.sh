#!/usr/bin/env bash
# From 20 minutes of logs of a car under its own driver, and 10 runs under a policy, to the corridor of that car
# (docs/your-data.md). The car is the bicycle of highway-env. Extra arguments are Hydra overrides.
set -euo pipefail
export PYTHONPATH=${PYTHONPATH:-src}:.:examples
root=${root:-runs/logs}
columns=t,p_x,p_y,yaw,v,v_y,yaw_rate,steering,acceleration,grip,push

# Runs one statement about the car, the box of its environment and the folder of the runs.
car() {
  python - "$root" "$columns" <<PROGRAM
import sys
from pathlib import Path

import highway
import recording
import sfkd_jax

root, columns = Path(sys.argv[1]), sys.argv[2]
car, box = highway.make(), ([0.35, -3], [1, 3])
policy = root / "car" / "sfkd_path" / "seed=0"
$1
PROGRAM
}

car 'recording.drive_by_hand(car, root / "logs", box, range(1000, 1020), 60, columns)'
python -m sfkd_jax.train +experiment=s3 name=car root="$root" \
  vehicle=logged vehicle.path="$root/logs" vehicle.wheelbase=5 \
  'vehicle.columns.state=[p_x,p_y,yaw,v,v_y,yaw_rate]' 'vehicle.columns.environment=[grip,push]' \
  dataset.segments=4000 'dataset.speed=[8,11]' 'dataset.law.speed=[8,11]' 'dataset.law.points=[13,3,5]' \
  certification.corridor.runs=40 certification.corridor.duration=20 certification.corridor.attack_steps=20000 \
  'evaluation.systems=[self]' "$@"
car 'recording.drive_under(sfkd_jax.load(policy), car, root / "recorded", box, range(10), 60)'
python -m sfkd_jax.collect name=car root="$root" collect.path="$root/recorded" certification.level=0.9
car 'recording.drive_under(sfkd_jax.load(policy), car, root / "further", box, range(100, 120), 60)'
python -m sfkd_jax.collect name=car root="$root" collect.path="$root/further"
