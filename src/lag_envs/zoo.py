"""Run a script of the RL Zoo on these environments (extra ``zoo``).

``python -m lag_envs.zoo record_video --algo ppo --env PivotedBar-v0 -f logs`` is
``python -m rl_zoo3.record_video`` with the environments registered. The Zoo's ``train`` and ``enjoy``
register them themselves if given ``--gym-packages lag_envs``; its other scripts lack that option. Here all of
them accept it.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec

import lag_envs  # noqa: F401  (registers the environments)
from lag_envs.errors import UserError
from lag_envs.options import module_parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Import the packages with environments, then run the script with the other arguments.

    Raises
    ------
    UserError
        If the Zoo is not installed or has no such script.
    """
    parser = module_parser(
        "lag_envs.zoo",
        "Run a script of the RL Zoo on these environments; all other arguments are the script's.",
        "examples:\n  python -m lag_envs.zoo record_video --algo ppo --env PivotedBar-v0 -f logs\n"
        "  python -m lag_envs.zoo train --help    the options of a script",
        add_help=False,
    )
    parser.add_argument("script", help="train, enjoy, record_video, record_training, ...")
    parser.add_argument("--gym-packages", nargs="+", default=[], metavar="PACKAGE")
    given = sys.argv[1:] if arguments is None else list(arguments)
    if given[:1] in (["-h"], ["--help"]):  # later, it belongs to the script
        parser.print_help()
        return
    args, others = parser.parse_known_args(given)
    if find_spec("rl_zoo3") is None:
        raise UserError('the RL Zoo is missing: pip install "lag-envs[zoo]"')
    if not args.script.isidentifier() or find_spec(f"rl_zoo3.{args.script}") is None:
        raise UserError(
            f"the RL Zoo has no script {args.script!r}; it has train, enjoy, record_video and others"
        )
    for package in args.gym_packages:
        import_module(package)
    sys.argv = [args.script, *others]
    runpy.run_module(f"rl_zoo3.{args.script}", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        sys.exit(f"lag_envs.zoo: error: {error}")
