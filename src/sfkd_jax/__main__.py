"""The program `sfkd`: `sfkd train` does what `python -m sfkd_jax.train` does."""

from __future__ import annotations

import sys
from importlib import import_module

from sfkd_jax.cli import messages
from sfkd_jax.cli.commands import COMMANDS, VERSION, module, summary
from sfkd_jax.cli.help import USAGE, information

COMPLETION = "completion"


def main() -> None:
    """Run the command that the first argument names; without one, list the commands."""
    command, *rest = sys.argv[1:] or ["--help"]
    if command in ("--help", "-h"):
        print(overview())
    elif command == "--version":
        print(VERSION)
    elif command == COMPLETION:
        # The import takes seconds, as that of a command does; the list is quick.
        print(import_module("sfkd_jax.cli.completion").script(rest))
    elif command in COMMANDS and (text := information(command, rest)):
        print(text)
    elif command in COMMANDS:
        entry = import_module("sfkd_jax.cli.entry")
        sys.argv = [f"sfkd {command}", *rest]
        entry.hydra_command(import_module(module(command)).run)()
    else:
        hint = messages.did_you_mean(command, (*COMMANDS, COMPLETION))
        sys.exit(f"sfkd_jax: unknown command {command}{hint or ';'} sfkd lists them")


def overview() -> str:
    """Return the page that lists the commands."""
    lines = {name: summary(name) for name in COMMANDS}
    lines[COMPLETION] = "Print a script for the TAB key: sfkd completion bash."
    width = max(map(len, lines))
    return "\n".join(
        [
            f"{VERSION}: learned dynamics with a stability certificate, driving MPPI.",
            "",
            f"usage: sfkd COMMAND {USAGE}",
            "",
            *(f"  {name:{width}}  {sentence}" for name, sentence in lines.items()),
            "",
            "sfkd COMMAND --help lists the groups and their options.",
            "python -m sfkd_jax.COMMAND does the same as sfkd COMMAND.",
        ]
    )


if __name__ == "__main__":
    main()
