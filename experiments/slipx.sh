#!/usr/bin/env bash
# From a 1/10 car that nobody here wrote to its corridor (docs/your-vehicle.md). The simulator is that of slipx
# (examples/slipx_car.py), whose grip and side force switch, and whose servo and tyres have states that no sensor
# shows. Beside the policy drive the law alone, MPPI with the textbook bicycle, Stanley's law and pure pursuit. The last
# line of the output is one line of JSON.
#
#     bash experiments/slipx.sh [--small] [root=DIR and other Hydra overrides]
set -euo pipefail
export PYTHONPATH=${PYTHONPATH:-src}:.:examples
root=runs
size=(
  dataset.segments=4000 training.steps=6000
  certification.corridor.runs=150
  evaluation.episodes=40 evaluation.episode_s=30
)
if [ "${1:-}" = --small ]; then
  shift
  size=(
    dataset.segments=1500 training.steps=1500
    certification.corridor.runs=40 certification.corridor.duration=20
    evaluation.episodes=6 evaluation.episode_s=20
    certification.corridor.attack_steps=20000
  )
fi
for word in "$@"; do
  case $word in root=*) root=${word#root=} ;; esac
done
car=(
  vehicle=simulator vehicle.env=slipx_car:make
  'environment.low=[0.5,-3]' 'environment.high=[1.1,3]'
  "${size[@]}"
)
path=(
  +experiment=s3 name=slipx "${car[@]}"
  'dataset.law.points=[13,5,5]' controller=mppi_path_300
)
python -m sfkd_jax.train "${path[@]}" 'evaluation.systems=[self]' "$@"
python -m sfkd_jax.evaluate "${path[@]}" controller.mppi.num_samples=1 \
  'evaluation.systems=[law_learned,law_stanley,law_pure_pursuit]' "$@"
python -m sfkd_jax.evaluate +experiment=s3_body name=slipx_nominal "${car[@]}" 'evaluation.systems=[nominal]' "$@"
python -m experiments.simulator "$root" slipx
