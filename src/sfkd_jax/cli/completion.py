"""Completion of `sfkd` on the TAB key of bash.

The script holds every word, so that the TAB key starts no Python.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

from sfkd_jax.cli import groups, options
from sfkd_jax.cli.commands import COMMANDS
from sfkd_jax.cli.schemas import is_schema

USAGE = """\
usage: sfkd completion bash

Prints a script. For all later shells, and again after an upgrade:
  mkdir -p ~/.local/share/bash-completion/completions
  sfkd completion bash > ~/.local/share/bash-completion/completions/sfkd
For this shell alone:
  eval "$(sfkd completion bash)\""""

SCRIPT = r"""# Completion of sfkd for bash, printed by: sfkd completion bash
_sfkd_commands="COMMANDS"
_sfkd_words="WORDS"

_sfkd() {
  local line=${COMP_LINE:0:COMP_POINT} words=$_sfkd_words typed candidate rest part
  local word=${line##*[[:space:]]}
  read -ra typed <<< "${line%"$word"}"
  (( ${#typed[@]} > 1 )) || words=$_sfkd_commands
  COMPREPLY=()
  for candidate in $(compgen -W "$words" -- "$word"); do
    rest=${candidate#"$word"} # one part of a dotted name at a time
    part=${rest%%[.=]*}
    candidate=$word$part${rest:${#part}:1}
    [[ " ${COMPREPLY[*]} " == *" $candidate "* ]] || COMPREPLY+=("$candidate")
  done
  [[ "${COMPREPLY[*]} " == *[.=]" "* ]] && compopt -o nospace
  if [[ $word == *=* && $COMP_WORDBREAKS == *=* ]]; then # = begins a word of its own
    part=${word%"${word##*=}"}
    COMPREPLY=("${COMPREPLY[@]#"$part"}")
  fi
}
complete -F _sfkd sfkd"""


def script(arguments: Sequence[str]) -> str:
    """Return the completion script, or how to ask for it."""
    if list(arguments) != ["bash"]:
        return USAGE
    text = SCRIPT.replace("COMMANDS", " ".join((*COMMANDS, "completion")))
    return text.replace("WORDS", " ".join(words()))


def words() -> list[str]:
    """Return each option as it is typed, and the name of each setting with a "="."""
    experiments = options.options(options.EXPERIMENT)
    chosen = [f"+{options.EXPERIMENT}={name}" for name in experiments]
    names = set(_names(groups.root_schema()))
    for group, schemas in groups.schemas().items():
        chosen += [f"{group}={name}" for name in options.options(group)]
        for schema in schemas.values():
            names |= set(_names(schema, f"{group}."))
    return [*chosen, *(f"{name}=" for name in sorted(names))]


def _names(schema: type, above: str = "") -> Iterator[str]:
    """Yield the dotted names of the settings of a schema."""
    for entry in dataclasses.fields(schema):
        if is_schema(entry.type):
            yield from _names(entry.type, f"{above}{entry.name}.")
        else:
            yield f"{above}{entry.name}"
