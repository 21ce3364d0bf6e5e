#!/usr/bin/env bash
# From a simulator that nobody here wrote to a car in its corridor (docs/your-vehicle.md): the dynamic bicycle of highway-env, whose grip and
# side force switch. Extra arguments are Hydra overrides.
set -euo pipefail
python -m sfkd_jax.train +experiment=s3 name=highway vehicle=simulator vehicle.env=tests.plants.simulators:highway \
  'environment.low=[0.35,-3]' 'environment.high=[1,3]' dataset.segments=1500 'dataset.speed=[8,11]' 'dataset.law.speed=[8,11]' \
  'dataset.law.points=[13,3,5]' training.steps=1500 certification.corridor.runs=40 certification.corridor.duration=20 \
  certification.corridor.attack_steps=20000 evaluation.episodes=6 evaluation.episode_s=30 "$@"
