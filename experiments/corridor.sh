#!/usr/bin/env bash
# SFKD along a path on both plants: trained, certified with its corridor, driven on S3 inside its shield (docs/corridor.md).
# What ships in src/sfkd_jax/pretrained/*_path was made by this. Extra arguments are Hydra overrides.
set -euo pipefail
for vehicle in dynamic kinematic; do
  python -m sfkd_jax.train +experiment=s3 vehicle="$vehicle" name="corridor_$vehicle" \
    certification.corridor.attack_steps=1000000 evaluation.episodes=16 "$@"
done
