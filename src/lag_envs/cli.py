"""The command ``lag-envs``.

To add a subcommand, write a file in `lag_envs.commands` and add its `Command` to `COMMANDS`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from lag_envs import __version__
from lag_envs.commands.base import Command
from lag_envs.commands.bench import BENCH
from lag_envs.commands.board import EXPORT, LEADERBOARD, REPLAY, VERIFY
from lag_envs.commands.cache import CACHE
from lag_envs.commands.completion import COMPLETION
from lag_envs.commands.hyperparams import HYPERPARAMS
from lag_envs.commands.info import INFO, LIST
from lag_envs.commands.new import NEW
from lag_envs.commands.order import ORDER
from lag_envs.commands.report import REPORT
from lag_envs.commands.show import PLAY, WATCH
from lag_envs.errors import UserError, hint, run_shown

#: In the order of ``lag-envs --help``.
COMMANDS: tuple[Command, ...] = (
    LIST, INFO, BENCH, ORDER, REPORT, PLAY, WATCH, NEW, COMPLETION, HYPERPARAMS, EXPORT, VERIFY, REPLAY,
    CACHE, LEADERBOARD,
)  # fmt: skip

EXAMPLES = """examples:
  lag-envs list                      list the environments
  lag-envs info PivotedBar-v0        describe one of them
  lag-envs play PivotedBar-v0        drive it yourself
  lag-envs watch PivotedBar-v0       watch an agent do it
  lag-envs new my_scene.py           start your own scene
  lag-envs bench --quick             compare their speed with other libraries
  lag-envs report --quick            compare their accuracy with other methods
  lag-envs leaderboard list          see which agents are best
  lag-envs bench --help              more about one command"""


def parser(command_name: str | None = None) -> argparse.ArgumentParser:
    """Return the parser of the whole command; a given name limits the arguments to that subcommand's."""
    whole = argparse.ArgumentParser(
        prog="lag-envs",
        allow_abbrev=False,
        description="Mechanics as Gymnasium environments, stepped to near machine precision.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    whole.add_argument("--version", action="version", version=f"lag-envs {__version__}")
    commands = whole.add_subparsers(title="commands", metavar="COMMAND")
    for command in COMMANDS:
        description, _, examples = command.description.partition("\n\nexamples:")
        one = commands.add_parser(
            command.name,
            allow_abbrev=False,  # so that a misspelt option cannot pass for another
            help=command.help,
            description=description,
            epilog=examples and "examples:" + examples,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if command_name in (None, command.name):
            command.declare(one)
        one.set_defaults(run=command.run, parser=parser, refuse=one.error)
    return whole


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its status, see `run_shown`; a mistake in the command line returns 2."""
    return run_shown("lag-envs", lambda: _run(sys.argv[1:] if arguments is None else arguments))


def _run(given: Sequence[str]) -> int:
    name, names = next((word for word in given if not word.startswith("-")), ""), [c.name for c in COMMANDS]
    if name and name not in names:
        raise UserError(f"there is no command {name!r}; {hint(name, names)}")
    whole = parser(name)
    args, unknown = whole.parse_known_args(given)
    if unknown:
        vars(args).get("refuse", whole.error)(f"unrecognized arguments: {' '.join(unknown)}")
    if "run" not in args:
        parser("").print_help(sys.stderr)
        return 2
    try:
        return args.run(args)
    except ArithmeticError as error:
        from lag_envs.scenes import StepRefused

        if not isinstance(error, StepRefused):
            raise
        raise UserError(str(error)) from error


if __name__ == "__main__":
    sys.exit(main())
