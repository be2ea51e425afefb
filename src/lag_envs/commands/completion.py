"""``lag-envs completion``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from lag_envs import TASKS
from lag_envs.commands.base import Command, needs

SHELLS = ("bash", "zsh", "tcsh")
#: Completion of environments and users' own files, for shells that complete by calling functions.
COMPLETE_ID = {"bash": "_lag_envs_ids", "zsh": "_lag_envs_ids", "tcsh": "f:*.py"}


def declare_completion(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``completion``."""
    parser.add_argument("shell", metavar="SHELL", choices=SHELLS, help=" or ".join(SHELLS))


def run_completion(args: argparse.Namespace) -> int:
    """Print the script that lets a shell complete the command."""
    needs("completion", "shtab")
    import shtab

    whole = args.parser()
    for one in _parsers(whole):
        for argument in one._actions:
            name = argument.metavar if isinstance(argument.metavar, str) else ""
            if argument.choices is not None:
                continue
            if argument.dest in ("id", "ids", "env"):
                argument.complete = COMPLETE_ID  # type: ignore[attr-defined]
            elif any(word in name for word in ("FOLDER", "PROJECT", "OUT")):
                argument.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
            elif "FILE" in name:
                argument.complete = shtab.FILE  # type: ignore[attr-defined]
    ids = " ".join(TASKS)
    preamble = {
        "bash": f'_lag_envs_ids() {{ compgen -W "{ids}" -- "$1"; compgen -f -X "!*.py" -- "$1"; }}',
        "zsh": "_lag_envs_ids() { _alternative "
        f"'ids:environment:({ids})' 'files:file:_files -g \"*.py\"' }}",
    }
    print(shtab.complete(whole, shell=args.shell, preamble=preamble))  # type: ignore[arg-type]
    return 0


def _parsers(whole: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield a parser and those of its subcommands."""
    yield whole
    for action in whole._actions:
        if isinstance(action, argparse._SubParsersAction):
            for one in action.choices.values():
                yield from _parsers(one)


COMPLETION = Command(
    "completion",
    "print a script that completes this command in a shell",
    """Print a script that lets a shell complete commands, options, environments and files (extra
`completion`).

examples:
  lag-envs completion bash > ~/.local/share/bash-completion/completions/lag-envs
  lag-envs completion zsh > ~/.zfunc/_lag-envs                  a folder of $fpath
  lag-envs completion tcsh > ~/.lag-envs.tcsh                   and in ~/.tcshrc: source ~/.lag-envs.tcsh""",
    declare_completion,
    run_completion,
)
