#!/usr/bin/env bash
# Measures what an accelerator is good for, in parts of at most ten minutes each:
#
#     bash benchmarks/gpu.sh [--small] [root=DIR] controls|speed|train|table ...
#
# controls  checks that the shipped policies return the controls that they return on a CPU
# speed     times control steps, and episodes that are simulated at once
# train     runs the main job
# table     drives sfkd-bench-3; the same command continues where it stopped
#
# --small makes `speed` a matter of seconds, so that one can try the script without an accelerator.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export PYTHONPATH=${PYTHONPATH:-src}:.
# With factors of ten bits the controls are others, and no witness of a certificate holds.
export JAX_DEFAULT_MATMUL_PRECISION=float32
root=runs/device
sizes=(--samples 1500 64 300 1024 4096 16384 65536 --steps 100 --episodes 1024)
parts=()
for word in "$@"; do
  case $word in
    --small) sizes=(--cars dynamic --samples 16 --steps 5 --episodes 0) ;;
    root=*) root=${word#root=} ;;
    controls | speed | train | table) parts+=("$word") ;;
    *) echo "no part $word; choose of controls, speed, train, table" >&2 && exit 2 ;;
  esac
done
[ "${#parts[@]}" -gt 0 ] || { echo "no part given; choose of controls, speed, train, table" >&2 && exit 2; }
mkdir -p "$root"
export JAX_COMPILATION_CACHE_DIR=${JAX_COMPILATION_CACHE_DIR:-$root/compiled}
for part in "${parts[@]}"; do
  case $part in
    controls) python -m pytest -q tests/test_goldens.py ;;
    speed) python -m benchmarks.device "${sizes[@]}" --out "$root/device.json" ;;
    train) time python -m sfkd_jax.train +experiment=s3 root="$root" ;;
    # 124: the time is up, and every cell that is done is kept.
    table) timeout 580 python -m sfkd_jax.compare +experiment=benchmark_path root="$root" || [ $? = 124 ] ;;
  esac
done
