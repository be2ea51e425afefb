"""``lag-envs play`` and ``lag-envs watch``."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lag_envs.commands.base import OWN_OR_MODULE, Command, known_id, needs, seconds
from lag_envs.errors import UserError
from lag_envs.options import count
from lag_envs.own_files import is_file
from lag_envs.store import named

if TYPE_CHECKING:
    from lag_envs.tasks.base import Task


def declare_play(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``play``."""
    _declare_shown(parser, "seed of the initial states")


def run_play(args: argparse.Namespace) -> int:
    """Let the user drive."""
    from gymnasium.error import Error

    needs("render", "pygame")
    from lag_envs.play import play

    id, _ = _shown(args)
    try:
        play(id, steps=args.steps, seed=args.seed, **_look(args))
    except (Error, ValueError) as error:
        raise UserError(str(error)) from error
    return 0


def declare_watch(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``watch``."""
    _declare_shown(parser, "seed of the first episode; later episodes use the numbers that follow")
    parser.add_argument(
        "--agent",
        metavar="NAME|FILE",
        help="the agent's name, as listed by `lag-envs info ID` or on the board; a submission's folder; or a"
        " model of Stable-Baselines3 (a zip, or the folder of its training), whose code is run (default: the"
        " policy that comes with the package; in other environments a controller of the task, or else zero)",
    )
    parser.add_argument(
        "--episodes",
        metavar="N",
        type=count,
        help="number of episodes (default: 1 with --video, otherwise no limit)",
    )
    parser.add_argument(
        "--video", metavar="FILE", type=Path, help="write an .mp4 or .gif instead of opening a window"
    )
    parser.add_argument(
        "--board",
        metavar="FOLDER",
        type=Path,
        help="a board in which to look up agents by name (default: the folder leaderboard, if it exists)",
    )


def run_watch(args: argparse.Namespace) -> int:
    """Show what an agent does."""
    import secrets

    from gymnasium.error import Error

    needs("render", *(["moviepy", "PIL"] if args.video else []), "pygame")
    needs("leaderboard", "packaging", "pydantic", "safetensors", "scipy", "sympy", "tomli_w")
    from lag_envs import watch

    id, task = _shown(args)
    board = Path("leaderboard") if args.board is None else args.board
    if not (board / "board.jsonl").is_file():
        if args.board is not None:
            raise UserError(f"--board: there is no board in {args.board}")
        board = None
    try:
        name, agent = watch.load_agent(id, task, args.agent, board)
        seed = secrets.randbelow(2**31) if args.seed is None else args.seed
        print(f"{id}: {name}", flush=True)
        limits = {"episodes": args.episodes, "steps": args.steps, "video": args.video}
        with nullcontext() if args.video is None else named(args.video):
            watch.watch(id, agent, seed=seed, **limits, **_look(args))
        if args.video is not None:
            print(f"{args.video} is written")
    except (Error, ValueError) as error:
        raise UserError(str(error)) from error
    return 0


def _declare_shown(parser: argparse.ArgumentParser, seed: str) -> None:
    """Declare the arguments of all commands that show an environment."""
    parser.add_argument(
        "id", metavar="ID|FILE", help=f"an environment, such as PivotedBar-v0, or {OWN_OR_MODULE}"
    )
    parser.add_argument("--seed", metavar="N", type=int, help=f"{seed} (default: a different one each time)")
    parser.add_argument("--steps", metavar="N", type=count, help="end after N steps (default: no limit)")
    parser.add_argument("--arrows", action="store_true", help="show arrows for controls and forces")
    parser.add_argument(
        "--trail", metavar="S", type=seconds, default=0.0,
        help="show the path of the last S seconds (default: none)",
    )  # fmt: skip
    parser.add_argument(
        "--readout", action="store_true",
        help="show time, return, controls, score and state below the picture",
    )  # fmt: skip


def _look(args: argparse.Namespace) -> dict[str, Any]:
    """Return an environment's keywords for rendering."""
    return {"show_arrows": args.arrows, "show_trail": args.trail, "show_readout": args.readout}


def _shown(args: argparse.Namespace) -> tuple[str, Task]:
    """Return id and task of the environment to show."""
    from lag_envs import own_files
    from lag_envs.envs.interface import LONGEST_TRAIL
    from lag_envs.tasks.registration import make_task

    if args.seed is not None and args.seed < 0:
        raise UserError(f"--seed must be at least 0, got {args.seed}")
    if args.trail > LONGEST_TRAIL:
        raise UserError(f"--trail must be at most {LONGEST_TRAIL:g} s, got {args.trail:g}")
    if not is_file(args.id):
        return (id := known_id(args.id)), make_task(id)
    task, path = own_files.one(args.id), own_files.split_path(args.id)[0]
    (id,) = own_files.registered(f"{path}:{task.__name__}")
    return id, make_task(id)


PLAY = Command(
    "play",
    "drive an environment by keys or gamepad",
    """Drive an environment in a window, in real time. The arrow keys drive the first two controls, and
a, d, s and w two more; the sticks of a gamepad do the same, in proportion. r starts over, q ends.
The end of an episode shows its return, and its score on the leaderboard's scale.

examples:
  lag-envs play PivotedBar-v0
  lag-envs play PivotedBar-v0 --seed 1       the same start each time
  lag-envs play PivotedBar-v0 --readout --trail 1
  lag-envs play ball_on_beam.py              a task of your own; this runs the file""",
    declare_play,
    run_play,
)
WATCH = Command(
    "watch",
    "watch an agent, in a window or as a video",
    """Watch an agent drive an environment, in a window, or write a video. By default, the agent is
the policy that comes with the package: the best network or table of the leaderboard, or a smaller
one where the best is large. Controllers are chosen by name. This needs the extras render and
leaderboard; models of your own also need agents.

examples:
  lag-envs watch PivotedBar-v0
  lag-envs watch PivotedBar-v0 --agent "energy shaping + LQR"
  lag-envs watch PivotedBar-v0 --seed 1 --video episode.mp4
  lag-envs watch PivotedBar-v0 --agent leaderboard/submissions/PivotedBar-v0-ppo-c1dc3900
  lag-envs watch ball_on_beam.py --agent model.zip   a task and a model of your own; this runs both""",
    declare_watch,
    run_watch,
)
