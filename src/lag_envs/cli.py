"""The command ``lag-envs``.

To add a subcommand, write a function that declares its arguments and one that runs it, and add an entry to
`COMMANDS`. What a subcommand needs is imported where it runs, so that ``lag-envs --help`` stays quick.
"""

from __future__ import annotations

import argparse
import inspect
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from datetime import date
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from lag_envs import TASKS, __version__
from lag_envs.errors import UserError, hint
from lag_envs.host import usable_cores
from lag_envs.own_files import is_file
from lag_envs.tables import columns

if TYPE_CHECKING:
    from lag_envs.tasks.base import Task


#: What `report`, `info`, `bench` and `play` take besides ids.
OWN = "a Python file of your own, FILE or FILE:Class, whose code is run"


class Command(NamedTuple):
    """A subcommand: how it is called, what it takes, what it does."""

    name: str
    help: str
    description: str
    declare: Callable[[argparse.ArgumentParser], Any]
    run: Callable[[argparse.Namespace], int]


# --- list ---


def run_list(args: argparse.Namespace) -> int:
    """Print a line for every environment."""
    head, *rows = columns([("id", "control", "dt", "steps", "length"), *(_line(id) for id in TASKS)])
    print(head)
    for id, row in zip(TASKS, rows, strict=True):
        print(f"{row}\n  {(inspect.getdoc(TASKS[id]) or '').partition(chr(10))[0]}")
    print(
        "\n`lag-envs info ID` tells more about one, `lag-envs play ID` lets you drive, "
        "`lag-envs watch ID` shows how it is done."
    )
    return 0


def _line(id: str) -> tuple[str, ...]:
    task = _task(id)
    return (
        id,
        ", ".join(_range(task, acting) for acting in task.formulas.acting),
        f"{task.dt:g} s",
        f"{task.limit:g}",
        f"{task.duration:g} s",
    )


def _range(task: Task, acting: Any) -> str:
    """Return a control's name, range and unit."""
    unit = dict(zip(task.scene.control_names, task.scene.control_units, strict=True))[acting.control]
    return f"{acting.control} {acting.low:g} to {acting.high:g} {unit}".rstrip()


# --- info ---


def declare_info(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``info``."""
    parser.add_argument("id", metavar="ID", help=f"an environment, such as PivotedBar-v0, or {OWN}")


def run_info(args: argparse.Namespace) -> int:
    """Print what there is to know about an environment."""
    from lag_envs.facts import facts

    if is_file(args.id):
        from lag_envs import own_files

        task = own_files.made(own_files.one(args.id), args.id)
        name = task.id or type(task).__name__
    else:
        name = _known(args.id)
        task = _task(name)
    print("\n".join(facts(task, name)))
    print("\n".join(_agents(task, name, args.id)))
    return 0


def _agents(task: Task, name: str, given: str) -> list[str]:
    """Return what there is to see of an environment."""
    from lag_envs.scores import known_returns
    from lag_envs.watch import known

    lines = ["", "Agents by name, and how to see them", *_rows(known(task, name))]
    lines += [f"  lag-envs watch {given} --agent NAME, or drive yourself: lag-envs play {given}"]
    if scale := known_returns(name):
        lines += [
            "",
            f"Returns: random actions {scale.random:.4g}, the best known {scale.best:.4g} ({scale.policy})",
        ]
    return lines


def _rows(rows: Sequence[tuple[str, ...]]) -> list[str]:
    return [f"  {line}" for line in columns(rows)]


# --- bench ---


def declare_bench(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``bench``."""
    parser.add_argument(
        "ids",
        metavar="ID",
        nargs="*",
        help=f"environments to measure (default: all; PivotedBar-v0 with --quick), or {OWN}",
    )
    parser.add_argument(
        "--quick", action="store_true", help="fewer and shorter samples, no cold start: under a minute"
    )
    parser.add_argument(
        "--cold", action="store_true", help="only the cold start: import, make, reset, first step"
    )
    parser.add_argument(
        "--output", metavar="FILE", help="write everything, raw samples included, to this JSON file"
    )
    parser.add_argument(
        "--checkout",
        metavar="FOLDER",
        help="take everything over into docs/speed.json, docs/speed.md and README.md of this checkout",
    )
    parser.add_argument(
        "--with",
        dest="keywords",
        metavar="KEYWORDS",
        action="append",
        type=_keywords,
        help="measure with these keywords too, as in --with 'action_delay=0.013'; repeatable",
    )
    parser.add_argument(
        "--sizes", metavar="N,N,...", type=_sizes, help="sizes of the batches (default: 1,64,1024,16384)"
    )
    parser.add_argument(
        "--threads",
        metavar="N",
        type=_count,
        default=1,
        help="measure also how much quicker N threads step a batch, on N cores",
    )
    parser.add_argument(
        "--rounds", metavar="N", type=_count, help="samples of each row (default: 31, or 9 with --quick)"
    )
    parser.add_argument(
        "--seconds",
        metavar="S",
        type=_seconds,
        help="length of a sample (default: 0.05, or 0.02 with --quick)",
    )
    parser.add_argument(
        "--clock",
        choices=["wall", "cpu"],
        default="wall",
        help="cpu leaves out what other programs take (default: wall)",
    )
    parser.add_argument(
        "--date", default=date.today().isoformat(), help="date to note in the file (default: today)"
    )


def run_bench(args: argparse.Namespace) -> int:
    """Compare speeds."""
    from lag_envs.benchmark import Settings, in_own_process

    ids, files = _measured(args.ids)
    ids = ids or (("PivotedBar-v0",) if args.quick or args.cold else tuple(TASKS))
    if args.output:
        _check_writable(Path(args.output))
    if args.checkout is not None:
        if args.threads > 1 or any(getattr(args, o) for o in ("ids", "quick", "cold", "sizes", "keywords")):
            raise UserError(
                "--checkout is for the whole measurement: leave out IDs, --quick, --cold, --sizes, --with, "
                "--threads"
            )
        for name in ("README.md", "docs/speed.json", "docs/speed.md"):
            if not os.access(Path(args.checkout, name), os.W_OK):
                raise UserError(
                    f"--checkout: {Path(args.checkout, name)} is not there, or cannot be written to"
                )
    if args.threads > (cores := usable_cores()):
        raise UserError(f"--threads {args.threads} needs as many cores, and this process may use {cores}")
    if args.threads > 1 and args.clock == "cpu":
        raise UserError("--threads needs --clock wall: the other adds up the time of all threads")
    quick = {"rounds": 9, "seconds": 0.02, "cold_starts": 3 if args.cold else 0} if args.quick else {}
    given = {
        name: getattr(args, name)
        for name in ("sizes", "rounds", "seconds")
        if getattr(args, name) is not None
    }
    plain = {
        "ids": ids,
        "files": files,
        "keywords": tuple(args.keywords or ()),
        "energies": not (args.quick or args.ids),
        "jacobians": not (args.quick or args.ids or args.cold),
        "divisions": not (args.quick or args.cold),
        "speed": not args.cold,
        "threads": args.threads,
        "clock": args.clock,
        "date": args.date,
        "output": args.output,
        "checkout": args.checkout,
    }
    return in_own_process(Settings(**(quick | given | plain)))


def _measured(names: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the ids that are meant, and those of the names that are files."""
    from lag_envs import own_files

    files = tuple(dict.fromkeys(name for name in names if is_file(name)))
    ids: list[str] = []
    for name in names:
        ids += own_files.registered(name) if name in files else [_known(name)]
    return tuple(dict.fromkeys(ids)), files


def _check_writable(path: Path) -> None:
    """Refuse before the measurement a file that could not be written after it."""
    if path.is_dir():
        raise UserError(f"--output must name a file, and {path} is a folder")
    if not path.absolute().parent.is_dir():
        raise UserError(f"--output: there is no folder {path.absolute().parent}")
    if not os.access(path if path.exists() else path.absolute().parent, os.W_OK):
        raise UserError(f"--output: {path} cannot be written to")


def _keywords(text: str) -> str:
    from lag_envs.benchmark import keywords_of

    try:
        keywords_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def _sizes(text: str) -> tuple[int, ...]:
    return tuple(map(_count, text.split(",")))


def _count(text: str) -> int:
    if not text.strip().isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"a whole number of at least 1 is needed, got {text!r}")
    return int(text)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"a number above 0 is needed, got {text!r}")
    return value


# --- order ---


def declare_order(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``order``."""
    parser.add_argument("id", metavar="ID", help=f"an environment, or {OWN}")
    parser.add_argument(
        "--num-envs", metavar="N", type=_count, default=1024, help="size of the batch (default: 1024)"
    )
    parser.add_argument("--rounds", metavar="N", type=_count, default=9, help="samples (default: 9)")


def run_order(args: argparse.Namespace) -> int:
    """Print what each order of the series costs, and which to choose."""
    from lag_envs import own_files
    from lag_envs.orders import ORDERS, lines, measure
    from lag_envs.progress import progress

    if is_file(args.id):
        kind = own_files.one(args.id)
        own_files.made(kind, args.id)
    else:
        kind = type(_task(_known(args.id)))
    with progress(args.rounds * len(ORDERS)) as advance:
        times = measure(kind, args.num_envs, args.rounds, advance=lambda: advance(kind.__name__))
    print("\n".join(lines(kind, times, kind().scene._order(kind().dt))))
    return 0


# --- report ---


def declare_report(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``report``."""
    parser.add_argument(
        "places", metavar="[FILE] [FOLDER]", nargs="*",
        help=f"{OWN}, if it is to be measured; and where to write (default: report, or report-NAME)",
    )  # fmt: skip
    parser.add_argument(
        "--quick", action="store_true", help="fewer cases and methods, the pivoted bar first: under a minute"
    )
    parser.add_argument(
        "--sections",
        metavar="NAME,...",
        help="only these: environments, work_precision, general, bound, stability, conservation, leave_out",
    )
    parser.add_argument(
        "--processes", metavar="N", type=_count, default=os.cpu_count() or 1,
        help="jobs side by side (default: one per core); timings always run alone",
    )  # fmt: skip
    parser.add_argument(
        "--date", default=date.today().isoformat(), help="date to note on the page (default: today)"
    )
    parser.add_argument("--docs", metavar="PROJECT", help="then write docs/accuracy in this checkout")


def run_report(args: argparse.Namespace) -> int:
    """Measure errors and write the page."""
    for package in ("flint", "jinja2", "matplotlib", "mpmath", "scipy", "sympy"):
        if find_spec(package) is None:
            raise UserError(f'{package} is missing: pip install "lag-envs[report]"')
    from lag_envs.report.report import SECTIONS, NotAReport, Settings, make_report

    file, folder = _places(args.places)
    if file:
        from lag_envs.report import own

        for option in ("sections", "docs"):
            if getattr(args, option):
                raise UserError(f"--{option} is for the report about this package: leave out it, or {file}")
        own.subjects(file)  # what is wrong with the file is said before anything is measured
        made = Settings(folder, args.quick, (own.SECTION,), args.processes, args.date, file)
        try:
            return 0 if make_report(made) else 130
        except (NotAReport, OSError) as error:
            raise UserError(str(error)) from error
    names = tuple(dict.fromkeys(args.sections.split(","))) if args.sections else SECTIONS
    for name in names:
        if name not in SECTIONS:
            raise UserError(f"there is no section {name!r}; {hint(name, SECTIONS)}")
    if args.docs and (args.quick or names != SECTIONS):
        raise UserError("--docs takes a whole report: leave out --quick and --sections")
    settings = Settings(folder, args.quick, names, args.processes, args.date)
    try:
        if not make_report(settings):
            return 130
        if args.docs:
            from lag_envs.report import docs

            return docs.main([folder, args.docs])
        return 0
    except (NotAReport, OSError) as error:
        raise UserError(str(error)) from error


def _places(places: Sequence[str]) -> tuple[str, str]:
    """Return the file that is measured, or nothing, and the report's folder."""
    files = [place for place in places if is_file(place) and not Path(place).is_dir() and ".py" in place]
    folders = [place for place in places if place not in files]
    if len(files) > 1 or len(folders) > 1:
        raise UserError(f"one FILE and one FOLDER at most, got {' '.join(places)}")
    if files:
        from lag_envs.own_files import split

        return files[0], folders[0] if folders else f"report-{Path(split(files[0])[0]).stem}"
    return "", folders[0] if folders else "report"


# --- play, watch ---


def declare_play(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``play``."""
    _declare_shown(parser, "seed of the starts")


def run_play(args: argparse.Namespace) -> int:
    """Let the user drive."""
    from gymnasium.error import Error

    _needs("render", "pygame")
    from lag_envs.play import play

    id, _ = _shown(args)
    try:
        play(id, steps=args.steps, seed=args.seed, **_look(args))
    except (Error, ValueError) as error:
        raise UserError(str(error)) from error
    return 0


def declare_watch(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``watch``."""
    _declare_shown(parser, "seed of the first episode, the others' follow it")
    parser.add_argument(
        "--agent",
        metavar="NAME|FILE",
        help="its name, as `lag-envs info ID` lists them, or on the board; a submission's folder; or a model"
        " of Stable-Baselines3 (a zip, or the folder of its training), whose code is run (default: the policy"
        " that comes with the package)",
    )
    parser.add_argument(
        "--episodes", metavar="N", type=_count, help="how many (default: 1 in a video, else endless)"
    )
    parser.add_argument(
        "--video", metavar="FILE", type=Path, help="write an .mp4 or .gif in place of opening a window"
    )
    parser.add_argument(
        "--board",
        metavar="FOLDER",
        type=Path,
        help="whose agents go by name too (default: the folder leaderboard, if there is one here)",
    )


def run_watch(args: argparse.Namespace) -> int:
    """Show what an agent does."""
    import secrets

    from gymnasium.error import Error

    _needs("render", *(["moviepy", "PIL"] if args.video else []), "pygame")
    _needs("leaderboard", "pydantic", "safetensors", "scipy", "sympy", "tomli_w")
    from lag_envs import watch

    id, task = _shown(args)
    board = Path("leaderboard") if args.board is None else args.board
    if not (board / "board.jsonl").is_file():
        if args.board is not None:
            raise UserError(f"--board: there is no board in {args.board}")
        board = None
    try:
        name, agent = watch.load(id, task, args.agent, board)
        seed = secrets.randbelow(2**31) if args.seed is None else args.seed
        print(f"{id}: {name}", flush=True)
        limits = {"episodes": args.episodes, "steps": args.steps, "video": args.video}
        watch.watch(id, agent, seed=seed, **limits, **_look(args))
        if args.video is not None:
            print(f"{args.video} is written")
    except ValueError as error:
        raise UserError(str(error)) from error
    except Error as error:
        raise UserError(f"{error}, and --video FILE neither") from error
    return 0


def _declare_shown(parser: argparse.ArgumentParser, seed: str) -> None:
    """Declare what all that shows an environment takes."""
    parser.add_argument("id", metavar="ID|FILE", help=f"an environment, such as PivotedBar-v0, or {OWN}")
    parser.add_argument("--seed", metavar="N", type=int, help=f"{seed} (default: another each time)")
    parser.add_argument("--steps", metavar="N", type=_count, help="end after so many steps")
    parser.add_argument("--arrows", action="store_true", help="show forces too")
    parser.add_argument(
        "--trail", metavar="S", type=_seconds, default=0.0, help="show the way of so many seconds"
    )
    parser.add_argument("--readout", action="store_true", help="show time, score, controls and state below")


def _look(args: argparse.Namespace) -> dict[str, Any]:
    """Return the keywords of an environment that say what is to be seen."""
    return {"show_arrows": args.arrows, "show_trail": args.trail, "show_readout": args.readout}


def _shown(args: argparse.Namespace) -> tuple[str, Task]:
    """Return id and task of what is to be shown."""
    from lag_envs import own_files
    from lag_envs.tasks.registration import make_task

    if args.seed is not None and args.seed < 0:
        raise UserError(f"--seed must be at least 0, got {args.seed}")
    if not is_file(args.id):
        return (id := _known(args.id)), _task(id)
    task, path = own_files.one(args.id), own_files.split(args.id)[0]
    (id,) = own_files.registered(f"{path}:{task.__name__}")
    return id, make_task(id)


def _needs(extra: str, *packages: str) -> None:
    """Raise a UserError that names what is missing, and its remedy."""
    for package in packages:
        if find_spec(package) is None:
            raise UserError(f'{package} is missing: pip install "lag-envs[{extra}]"')


# --- new ---


def declare_new(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``new``."""
    parser.add_argument("file", metavar="FILE", help="the file to write, such as my_scene.py")


def run_new(args: argparse.Namespace) -> int:
    """Write a scene and a task to start from."""
    from lag_envs.starter import start

    path = start(Path(args.file))
    print(
        f"{path} is written: a pendulum, its energies and a task. Change them, then:\n"
        f"  lag-envs info {path}       what follows from the energies\n"
        f"  lag-envs play {path}       drive it\n"
        f"  lag-envs report {path}     measure its errors"
    )
    return 0


# --- completion ---


def declare_completion(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``completion``."""
    parser.add_argument("shell", metavar="SHELL", choices=SHELLS, help=" or ".join(SHELLS))


def run_completion(args: argparse.Namespace) -> int:
    """Print the script with which a shell completes the command."""
    _needs("completion", "shtab")
    import shtab

    whole = parser()
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


SHELLS = ("bash", "zsh", "tcsh")
#: Environments and a user's own files, for the shells in which functions complete.
COMPLETE_ID = {"bash": "_lag_envs_ids", "zsh": "_lag_envs_ids", "tcsh": "f:*.py"}


def _parsers(whole: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield a parser and those of its subcommands."""
    yield whole
    for action in whole._actions:
        if isinstance(action, argparse._SubParsersAction):
            for one in action.choices.values():
                yield from _parsers(one)


# --- hyperparams ---


def declare_hyperparams(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``hyperparams``."""
    parser.add_argument(
        "learner", metavar="LEARNER", help="ppo, sac, td3, tqc, dqn, fast_ppo, shac or cloning"
    )


def run_hyperparams(args: argparse.Namespace) -> int:
    """Print the hyperparameters of a learner."""
    from lag_envs.hyperparams import as_yaml, learners

    if args.learner not in learners():
        raise UserError(f"there is no learner {args.learner!r}; {hint(args.learner, learners())}")
    print(as_yaml(args.learner, {id: task() for id, task in TASKS.items()}), end="")
    return 0


# --- leaderboard, verify, export ---


def _replay(function: str) -> Callable[..., Any]:
    return lambda *arguments: getattr(import_module("lag_envs.replay"), function)(*arguments)


def _leaderboard(module: str, function: str) -> Callable[[Any], Any]:
    """Return a function of the leaderboard, imported when it is called; its errors become UserErrors."""

    def call(given: Any) -> Any:
        for package in (
            "confusable_homoglyphs", "jinja2", "pebble", "pydantic", "safetensors", "scipy", "sympy",
            "tomli_w", "tqdm",
        ):  # fmt: skip
            if find_spec(package) is None:
                raise UserError(f'{package} is missing: pip install "lag-envs[leaderboard]"')
        from lag_envs.leaderboard.board import BoardError
        from lag_envs.leaderboard.submission import Refused
        from lag_envs.workers import SpreadError

        try:
            return getattr(import_module(f"lag_envs.leaderboard.{module}"), function)(given)
        except (BoardError, Refused, SpreadError, OSError) as error:
            if isinstance(error, BrokenPipeError):
                raise
            raise UserError(str(error)) from error

    return call


# --- cache ---


def declare_cache(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``cache``."""
    parser.add_argument("--clear", action="store_true", help="remove all that is kept")


def run_cache(args: argparse.Namespace) -> int:
    """Show what compiled code is kept on disk and check it, or remove it."""
    from lag_envs.stepping import cache

    place = cache.folder()
    if place is None:
        print("There is no folder for caches: each process compiles what it uses.")
        return 0
    if args.clear:
        print(f"{place}: {cache.clear(place)} files removed")
        return 0
    kept = cache.entries(place)
    size = sum(entry.size for entry in kept)
    rows = [
        ("folder", str(place)),
        ("functions", str(len(kept))),
        ("size", f"{size / 2**20:.1f} MiB of {cache.LIMIT / 2**20:.0f} at most"),
        ("writable", "yes" if cache.writable(place) else "no: each process compiles what is not here"),
    ]
    damaged = [(str(entry.path), why) for entry in kept if (why := cache.damage(entry.path))]
    rows += [("damaged", str(len(damaged)) + (", compiled anew when used next:" if damaged else ""))]
    print("\n".join(columns(rows) + columns([("  " + path, why) for path, why in damaged])))
    return 0


# --- the command ---

COMMANDS: tuple[Command, ...] = (
    Command(
        "list",
        "list the environments",
        """List the environments: what to do, control, control interval, steps and length of an episode.

examples:
  lag-envs list
  lag-envs list | grep Incline""",
        lambda parser: None,
        run_list,
    ),
    Command(
        "info",
        "tell about one environment",
        """Tell about one environment: state, control, observation bounds, start, parameters, accuracy.

examples:
  lag-envs info PivotedBar-v0
  lag-envs info ball_on_beam.py              a task of your own; this runs the file
  lag-envs info mine.py:Balance              one of several""",
        declare_info,
        run_info,
    ),
    Command(
        "bench",
        "compare the speed with other libraries",
        """Compare steps per second with Gymnasium and, where installed, EnvPool, gymnax and TorchRL, in one
run on one core: each round takes a sample of every row, and ratios are taken within a round. Then time
the cold start of whole processes. Ctrl-C ends the measurement and keeps what there is.

examples:
  lag-envs bench --quick                             one environment, under a minute
  lag-envs bench --output speed.json                 everything, a few minutes
  lag-envs bench --checkout .                        the same, into the documentation of a clone
  lag-envs bench PivotedBar-v0 --sizes 64,16384
  lag-envs bench --quick ball_on_beam.py             tasks of your own; this runs the file
  lag-envs bench --quick --with action_delay=0.013   what keywords cost
  lag-envs bench --quick --threads 2                 what a second thread brings
  lag-envs bench --cold                              only the cold start
  lag-envs bench --quick --clock cpu                 on a machine that has other work to do""",
        declare_bench,
        run_bench,
    ),
    Command(
        "order",
        "find the order of the series that steps a task fastest",
        """Measure the time of a step by each order of the series, under random actions in a task's own
episodes, and tell which one to write into the task. With any order each step is certified alike.

examples:
  lag-envs order ball_on_beam.py             a task of your own; this runs the file
  lag-envs order mine.py:Balance             one of several""",
        declare_order,
        run_order,
    ),
    Command(
        "report",
        "measure errors, and write a page about them",
        """Measure the error of every environment and scene against high precision, beside usual integrators
and other libraries: error against run time, the bound, stability on stiff and extreme cases, conservation.
Writes a folder with index.html, figures, tables as CSV and everything as JSON. Finished jobs are kept: after
Ctrl-C, re-run it to resume. heyoka, diffrax, torchdiffeq and MuJoCo take part where they are installed.

examples:
  lag-envs report --quick                            a first look, under a minute
  lag-envs report                                    everything, about half an hour on two cores
  lag-envs report --docs .                           the same, and what this checkout says of it
  lag-envs report --sections bound,stability maps    two parts, into the folder maps
  lag-envs report ball_on_beam.py                    scenes of your own, into report-ball_on_beam;
                                                     this runs the file""",
        declare_report,
        run_report,
    ),
    Command(
        "play",
        "drive an environment by keys or gamepad",
        """Drive an environment in a window, in real time: the arrow keys are for the first two controls,
a, d, s and w for two more; the sticks of a gamepad do the same, little by little. At an episode's end it
tells the return, and the score on the leaderboard's scale.

examples:
  lag-envs play PivotedBar-v0
  lag-envs play PivotedBar-v0 --seed 1       the same start each time
  lag-envs play PivotedBar-v0 --readout --trail 1
  lag-envs play ball_on_beam.py              a task of your own; this runs the file""",
        declare_play,
        run_play,
    ),
    Command(
        "watch",
        "watch an agent, in a window or as a video",
        """Watch an agent drive an environment, in a window, or write a video. By default it is the policy
that comes with the package, the best of the leaderboard; controllers go by name.

examples:
  lag-envs watch PivotedBar-v0
  lag-envs watch PivotedBar-v0 --agent "energy shaping + LQR"
  lag-envs watch PivotedBar-v0 --seed 1 --video episode.mp4
  lag-envs watch PivotedBar-v0 --agent leaderboard/submissions/PivotedBar-v0-ppo-c1dc3900
  lag-envs watch ball_on_beam.py --agent model.zip     a task and a model of your own; this runs both""",
        declare_watch,
        run_watch,
    ),
    Command(
        "new",
        "write a scene and a task to start from",
        """Write a file with a scene and a task of your own to start from, with comments. A file that is there
is left as it is.

examples:
  lag-envs new my_scene.py
  lag-envs info my_scene.py""",
        declare_new,
        run_new,
    ),
    Command(
        "completion",
        "print a script that completes this command in a shell",
        """Print a script with which a shell completes commands, options, environments and files (extra
`completion`).

examples:
  lag-envs completion bash > ~/.local/share/bash-completion/completions/lag-envs
  lag-envs completion zsh > ~/.zfunc/_lag-envs                  a folder of $fpath
  lag-envs completion tcsh > ~/.lag-envs.tcsh                   and in ~/.tcshrc: source ~/.lag-envs.tcsh""",
        declare_completion,
        run_completion,
    ),
    Command(
        "hyperparams",
        "print hyperparameters for the RL Zoo",
        """Print the hyperparameters of a learner of Stable-Baselines3 for all environments, in the form of
the RL Zoo (extra `zoo`). They are those that the agents of docs/agents.md were trained with. Those of
fast_ppo, shac and cloning are for `python -m agents.train`, in a clone.

examples:
  lag-envs hyperparams ppo > ppo.yml
  python -m rl_zoo3.train --algo ppo --env PivotedBar-v0 --gym-packages lag_envs --conf-file ppo.yml
  python -m rl_zoo3.enjoy --algo ppo --env PivotedBar-v0 --gym-packages lag_envs -f logs
  python -m lag_envs.zoo record_video --algo ppo --env PivotedBar-v0 -f logs""",
        declare_hyperparams,
        run_hyperparams,
    ),
    Command(
        "export",
        "turn a trained model into a submission",
        """Turn models of Stable-Baselines3 into a submission to the leaderboard, which is data only, and
prove that both act alike. Loading a model runs code, so export your own only. Networks that
`python -m agents.ppo` left are data already, and are taken as they are.

examples:
  lag-envs export runs/PivotedBar-v0/ppo --author "A. Author" --license MIT    all seeds of a training here
  lag-envs export s0.zip s1.zip s2.zip s3.zip s4.zip --env PivotedBar-v0 --env-steps 500000 --seconds 600 \\
      --author "A. Author" --license MIT                                       models from elsewhere""",
        _leaderboard("export", "declare_export"),
        _leaderboard("export", "run_export"),
    ),
    Command(
        "verify",
        "recompute the scores of a submission",
        """Check submissions to the leaderboard and recompute their scores. Nothing in them is run, and
nothing is changed.

examples:
  lag-envs verify PivotedBar-v0-PPO                  1,000 episodes of each policy
  lag-envs verify PivotedBar-v0-PPO --episodes 50    a first look
  lag-envs verify leaderboard/inbox/* --jobs 8       several side by side
  lag-envs verify leaderboard/inbox/* --ray auto     on the machines of a Ray cluster""",
        _leaderboard("verify", "declare_verify"),
        _leaderboard("verify", "run_verify"),
    ),
    Command(
        "replay",
        "recompute a drive from its link",
        """Recompute a drive, which the leaderboard's page made a link of, from its seed and keys, by
arithmetic that has the same bits on every machine, and say whether the return that the link claims is true.
The status is 0 where it is, 1 where it is not, 2 for a link that is damaged.

examples:
  lag-envs replay 'https://example.org/board/PivotedBar-v0.html#drive=1~...'
  lag-envs replay '#drive=1~...' --file mine.py      of an environment of your own""",
        _replay("declare"),
        _replay("run"),
    ),
    Command(
        "cache",
        "show or clear what is compiled",
        """Show where compiled code is kept, how much of it there is, and whether it is whole. It is kept in
the user's folder for caches, or in the one that the environment variable NUMBA_CACHE_DIR names.

examples:
  lag-envs cache            what there is
  lag-envs cache --clear    remove it; what is needed is compiled anew""",
        declare_cache,
        run_cache,
    ),
    Command(
        "leaderboard",
        "keep the leaderboard",
        """Keep a leaderboard: take submissions in, recompute their scores, show and publish the ranking. A
submission is verified with a nonce that was published after it was added: `add` takes it in, `nonce`
publishes one and verifies what waits. After Ctrl-C, or a kill, `add` without a folder goes on.

examples:
  lag-envs leaderboard add my-submission             take it in; it waits for the next nonce
  lag-envs leaderboard nonce 5f3c...                 publish a nonce, verify what waits for it
  lag-envs leaderboard add mine/* --nonce test-1     both at once, for a board of your own
  lag-envs leaderboard list PivotedBar-v0            the ranking, and the state of the others
  lag-envs leaderboard serve                         the page, at http://127.0.0.1:8000
  lag-envs leaderboard add --help                    more about one action""",
        _leaderboard("cli", "declare_leaderboard"),
        _leaderboard("cli", "run_leaderboard"),
    ),
)

EXAMPLES = """examples:
  lag-envs list                      what environments there are
  lag-envs info PivotedBar-v0        all about one of them
  lag-envs play PivotedBar-v0        drive it
  lag-envs watch PivotedBar-v0       see how it is done
  lag-envs new my_scene.py           begin one of your own
  lag-envs bench --quick             how fast they are beside others
  lag-envs report --quick            how wrong they are beside others
  lag-envs leaderboard list          who is best at them
  lag-envs bench --help              more about one command"""


def parser(command_name: str | None = None) -> argparse.ArgumentParser:
    """Return the parser of the whole command; given a subcommand, only its arguments are declared."""
    whole = argparse.ArgumentParser(
        prog="lag-envs",
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
            help=command.help,
            description=description,
            epilog=examples and "examples:" + examples,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if command_name in (None, command.name):
            command.declare(one)
        one.set_defaults(run=command.run)
    return whole


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its status: 0, 2 for a mistake in the command line, 130 when interrupted."""
    given = sys.argv[1:] if arguments is None else arguments
    try:
        args = parser(next((word for word in given if not word.startswith("-")), "")).parse_args(given)
        if "run" not in args:
            parser("").print_help(sys.stderr)
            return 2
        return args.run(args)
    except UserError as error:
        print(f"lag-envs: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # The reader, such as `head`, has left; nothing more is to be written, at exit either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


# --- what several need ---


def _known(id: str) -> str:
    """Return the id, or raise a UserError that names similar ones."""
    if id in TASKS:
        return id
    raise UserError(
        f"there is no environment {id!r}; {hint(id, TASKS, '`lag-envs list` names all')} "
        "(a file of your own ends with .py)"
    )


def _task(id: str) -> Task:
    return TASKS[id]()


if __name__ == "__main__":
    sys.exit(main())
