#!/usr/bin/env bash
# Systems that are no cars (examples/systems), each from its equations to a certificate, and driven beside its law, an
# oracle and a nominal model. Prints one line of JSON for each system; the same command continues what was interrupted.
#
#     bash experiments/systems.sh [--small] [--write] [root=DIR] [NAME ...]
#
# --small takes two systems in sizes of a few minutes each. --write makes experiments/systems.json of the lines in DIR.
set -euo pipefail
export PYTHONPATH=${PYTHONPATH:-src}:.
root=runs/systems
words=()
for word in "$@"; do
  case $word in root=*) root=${word#root=} ;; *) words+=("$word") ;; esac
done
python -m experiments.systems "$root" "${words[@]}"
