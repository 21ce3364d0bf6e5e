# The journey from a simulator to its corridor (docs/your-vehicle.md): train, certify, drive beside its rivals, and
# print one line of JSON. simulator.sh and slipx.sh source it with their arguments, after they have set
#
#     name       of the runs
#     seconds    of a run, in full size and with --small
#     vehicle    words of the vehicle and of its environment
#     policy     words of what is learned
#     estimated  words with which the policy estimates its environment; without any it does not
set -euo pipefail
export PYTHONPATH=${PYTHONPATH:-src}:.:examples
root=runs
size=(
  dataset.segments=4000 training.steps=6000
  certification.corridor.runs=150 "certification.corridor.duration=${seconds[0]}" certification.corridor.attack_steps=20000
  evaluation.episodes=40 "evaluation.episode_s=${seconds[0]}"
)
if [ "${1:-}" = --small ]; then
  shift
  size=(
    dataset.segments=1500 training.steps=1500
    certification.corridor.runs=40 certification.corridor.duration=20 certification.corridor.attack_steps=20000
    evaluation.episodes=6 "evaluation.episode_s=${seconds[1]}"
  )
fi
for word in "$@"; do
  case $word in root=*) root=${word#root=} ;; esac
done
car=(vehicle=simulator "${vehicle[@]}" "${size[@]}")
path=(+experiment=s3 name="$name" "${car[@]}" "${policy[@]}" controller=mppi_path_300)
python -m sfkd_jax.train "${path[@]}" 'evaluation.systems=[self]' "$@"
if [ ${#estimated[@]} -gt 0 ]; then
  python -m sfkd_jax.evaluate "${path[@]}" 'evaluation.systems=[self]' "${estimated[@]}" "$@"
fi
# With one sample a law drives alone. Beside another law than its own the model is the simulator itself, which rolls out
# every plan, so that the horizon is short.
alone=("${path[@]}" controller.mppi.num_samples=1)
python -m sfkd_jax.evaluate "${alone[@]}" 'evaluation.systems=[self]' "$@"
python -m sfkd_jax.evaluate "${alone[@]}" controller.mppi.horizon=3 \
  'evaluation.systems=[law_stanley,law_pure_pursuit]' "$@"
python -m sfkd_jax.evaluate +experiment=s3_body name="${name}_nominal" "${car[@]}" 'evaluation.systems=[nominal]' "$@"
python -m experiments.simulator "$root" "$name"
