"""One training run in its folder: settings, progress, checkpoint and result.

A folder holds ``checkpoint.pkl`` while the run is not finished (everything that is needed to resume),
then ``model.zip`` and ``result.json``. Files are replaced as a whole, so a kill at any moment leaves a
readable folder.
"""

from __future__ import annotations

import argparse
import json
import pickle
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import wraps
from hashlib import sha256
from pathlib import Path
from typing import Any

from lag_envs import TASKS, own_files
from lag_envs.errors import UserError, hint, run_shown
from lag_envs.scenes.base import Scene
from lag_envs.store import write_file
from lag_envs.tasks.base import Task
from lag_envs.tasks.registration import make_task

SCHEMA = 1
#: Seeds of the episodes on which agents are compared, and of those on which a policy is tested during
#: training. Training itself never uses them.
FIRST_FRESH_SEED = 1_000_000_000
FIRST_TEST_SEED = 2_000_000_000
CHECKPOINT, MODEL, NORMALISATION, RESULT = "checkpoint.pkl", "model.zip", "vecnormalize.pkl", "result.json"
#: Number of seeds for trainings, see `first_training_seed`.
SEEDS = 1000
#: The beginning of a checkpoint; the digest of its content follows.
DIGEST = b"sha256:"
#: Types of the entries that are read from a result.
NUMBER = (int, float)
KINDS: dict[str, Any] = {
    "env": str, "algo": str, "seed": int, "steps": int, "hyperparameters": dict, "trained": int,
    "wall_seconds": NUMBER, "mean_return": NUMBER, "score": (*NUMBER, type(None)),
}  # fmt: skip


def fresh_seeds(episodes: int) -> range:
    """Return the seeds of the first episodes of those on which agents are compared."""
    return range(FIRST_FRESH_SEED, FIRST_FRESH_SEED + episodes)


def first_training_seed(seed: int) -> int:
    """Return the seed of a training's first environment; no two trainings share an episode."""
    return 1_000_000 * seed % FIRST_FRESH_SEED


def training_seeds(first: int, count: int) -> range:
    """Return `count` training seeds, or raise a UserError if one would repeat another's episodes."""
    if first + count > SEEDS:
        raise UserError(
            f"training seeds must lie below {SEEDS}, so that no two share an episode; got up to "
            f"{first + count - 1}"
        )
    return range(first, first + count)


@dataclass
class Run:
    """A run's settings and progress.

    Parameters
    ----------
    folder : Path
        Folder of all the run's files.
    env, algo, seed, steps : str, str, int, int
        Id of the environment, name of the learner, seed, steps to train for.
    hyperparameters : dict
        Hyperparameters, in the form of `lag_envs.hyperparams`.
    """

    folder: Path
    env: str
    algo: str
    seed: int
    steps: int
    hyperparameters: dict[str, Any]
    #: The file or module of the user's own environment, as it was given; empty for one of the package.
    source: str = ""
    #: The digest of the files that define it, see `source_digest`.
    digest: str = ""
    trained: int = 0
    #: Wall time and processor time of training alone, without compiling, tests and evaluation.
    seconds: float = 0.0
    processor_seconds: float = 0.0
    #: Steps so far, seconds so far, mean return of the policy then.
    curve: list[tuple[int, float, float]] = field(default_factory=list)
    since: tuple[float, float] = 0.0, 0.0

    @property
    def settings(self) -> dict[str, Any]:
        """The settings that a checkpoint must have been made with."""
        names = ("env", "algo", "seed", "steps", "hyperparameters", *["digest"] * bool(self.source))
        return {"schema": SCHEMA} | {name: getattr(self, name) for name in names}

    @property
    def name(self) -> str:
        """The run's name in messages."""
        return f"{self.env} {self.algo} seed {self.seed}"

    def path(self, name: str) -> Path:
        """Return the path of one of the run's files."""
        return self.folder / name

    def start_clock(self) -> None:
        """Start the clock of training time."""
        self.since = time.perf_counter(), time.process_time()

    def stop_clock(self) -> None:
        """Stop the clock, and add its time to the training time."""
        self.seconds += time.perf_counter() - self.since[0]
        self.processor_seconds += time.process_time() - self.since[1]

    # --- files ----------------------------------------------------------------------------------------------

    def save_checkpoint(self, content: dict[str, Any]) -> None:
        """Write everything that is needed to resume."""
        names = ("trained", "seconds", "processor_seconds", "curve")
        progress = {name: getattr(self, name) for name in names}
        data = pickle.dumps({"settings": self.settings, "progress": progress, **content})
        write_file(self.path(CHECKPOINT), DIGEST + sha256(data).digest() + data)

    def load_checkpoint(self) -> dict[str, Any] | None:
        """Return the checkpoint and adopt its progress, or return None if there is none.

        Raises
        ------
        UserError
            For a file that cannot be read or that belongs to another run.
        """
        file = self.path(CHECKPOINT)
        if not file.exists():
            return None
        try:
            data = file.read_bytes()
            if data.startswith(DIGEST):  # earlier versions wrote no digest
                digest, data = data[len(DIGEST) :][:32], data[len(DIGEST) + 32 :]
                if sha256(data).digest() != digest:
                    raise ValueError("it is damaged: its digest does not match")
            content = pickle.loads(data)
            settings, progress = content["settings"], content["progress"]
            for name in progress:
                setattr(self, name, progress[name])
        except Exception as error:  # a damaged pickle can raise anything
            reason = f"{type(error).__name__}: {error}"
            raise UserError(f"{file} cannot be read ({reason}); --new starts over") from error
        self.check_settings(settings, file)
        return content

    def load_result(self) -> dict[str, Any] | None:
        """Return the result of a run that is finished, else None; raises as `load_checkpoint` does."""
        file = self.path(RESULT)
        if not file.exists():
            return None
        content = read_result(file)
        self.check_settings(content, file)
        if not self.path(MODEL).exists():
            raise UserError(
                f"{file} exists, but no {MODEL}; remove it to train again, or start over with --new"
            )
        return content

    def check_settings(self, found: dict[str, Any], file: Path) -> None:
        """Raise UserError if a file belongs to a run with other settings."""
        for name, value in self.settings.items():
            if found.get(name) != value:
                what = f"{name} {found.get(name)!r}, not {value!r}"
                if name == "digest":
                    raise UserError(
                        f"{file} belongs to another version of {self.source}; --new starts over, --output "
                        "goes elsewhere"
                    )
                if name == "hyperparameters":
                    both = {**value, **(found.get(name) or {})}
                    other = [k for k in both if value.get(k) != (found.get(name) or {}).get(k)]
                    what = f"other hyperparameters ({', '.join(map(str, other))})"
                raise UserError(
                    f"{file} belongs to a run with {what}; --new starts over, --output goes elsewhere"
                )

    def foreign(self) -> bool:
        """Return whether the folder holds files that do not belong to the run."""
        found = self.folder.iterdir() if self.folder.exists() else ()
        return any(f.name != "tensorboard" and not f.name.endswith(".part") for f in found)

    def remove(self) -> None:
        """Remove the run's files, and no other files."""
        for name in (CHECKPOINT, MODEL, NORMALISATION, RESULT):
            self.path(name).unlink(missing_ok=True)
        for file in self.folder.glob("tensorboard/*/events.out.tfevents.*"):
            file.unlink()


def read_result(file: Path) -> dict[str, Any]:
    """Return the contents of a run's ``result.json``.

    Raises
    ------
    UserError
        If the file cannot be read.
    """
    try:
        content = json.loads(file.read_text())
        if not isinstance(content, dict) or content.get("schema") != SCHEMA:
            raise ValueError("it was not written by this version")
        if not isinstance(content["evaluation"]["returns"], list):
            raise ValueError("its returns are not a list")
        for name, kind in KINDS.items():
            if not isinstance(content[name], kind):
                raise ValueError(f"its {name} is {content[name]!r}")
        for point in content["curve"]:
            if len(point) != 3 or not all(isinstance(number, NUMBER) for number in point):
                raise ValueError(f"its curve has {point!r}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{file} cannot be read ({error}); remove it, or start over with --new") from error
    return content


def check_env(env_id: str) -> str:
    """Return the id of an environment of the package, or raise a UserError that suggests similar ids."""
    if own_files.is_file(env_id) or ":" in env_id:
        raise UserError(
            f"this command is for ids of the package, got {env_id}; agents.train and agents.ppo train on "
            "tasks of your own"
        )
    return known_name("environment", env_id, TASKS)


def own_env(name: str) -> str:
    """Return the id for a name: one of the package's, ``module:Id``, ``FILE`` or ``FILE:Class``.

    A user's file or module is run, and the environments that it defines are registered.

    Raises
    ------
    UserError
        If there is no environment, or several.
    """
    if own_files.is_file(name):
        own_files.one(name)
        return own_files.registered(name)[0]
    return own_files.imported(name) if ":" in name else check_env(name)


def source_digest(source: str, env_id: str) -> str:
    """Return the digest of the files that define a user's task: the given module, and those of its classes.

    The classes are those of task and scene. Changes in other files that they call go unnoticed.
    """
    task, modules = make_task(env_id), [source.partition(":")[0]]
    for kind, base in ((type(task), Task), (type(task.scene), Scene)):
        own = kind.__mro__[: kind.__mro__.index(base)]
        modules += [each.__module__ for each in own if not each.__module__.startswith("lag_envs.")]
    files = {getattr(sys.modules.get(name), "__file__", None): None for name in modules}
    return sha256(b"".join(Path(file).read_bytes() for file in files if file)).hexdigest()


def known_name(kind: str, name: str, known: Iterable[str]) -> str:
    """Return a known name, or raise a UserError with similar ones."""
    known = list(known)
    if name in known:
        return name
    raise UserError(f"there is no {kind} {name!r}; {hint(name, known)}")


def check_numbers(args: argparse.Namespace, **least: int) -> None:
    """Raise a UserError for an option that does not lie between its least value and 2³¹ - 1."""
    for name, smallest in least.items():
        value = getattr(args, name)
        if value is not None and not smallest <= value < 2**31:
            option = "--" + name.replace("_", "-")
            raise UserError(f"{option} must lie between {smallest} and 2147483647, got {value}")


def check_writable(file: Path) -> None:
    """Raise a UserError for a file that cannot be written or extended, before hours of work on it."""
    if file.exists() and not file.is_file():
        raise UserError(f"{file} is not a regular file, so nothing would be kept for the next time")
    try:
        folder = file.resolve().parent
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder, buffering=0) as probe:  # the file itself is left alone
            fits = probe.write(bytes(4096)) == 4096
        if file.exists():
            file.open("ab").close()
    except OSError as error:
        raise UserError(f"{file} cannot be written: {error.strerror}") from error
    if not fits:
        raise UserError(f"{file} cannot be written: no space left")


def reports_errors(program: str) -> Callable[[Callable[..., int]], Callable[..., int]]:
    """Make the function of ``python -m PROGRAM`` show errors in a line and obey SIGTERM, see `run_shown`."""

    def decorated(main: Callable[..., int]) -> Callable[..., int]:
        @wraps(main)
        def run(arguments: Sequence[str] | None = None) -> int:
            return run_shown(f"python -m {program}", lambda: main(arguments))

        return run

    return decorated
