"""Watch an agent; the command ``lag-envs watch``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Self

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lag_envs.envs.screen import check_display
from lag_envs.errors import UserError, hint
from lag_envs.leaderboard.shipped import shipped
from lag_envs.scores import in_words

#: Supported extensions of video files.
VIDEOS = (".mp4", ".gif")
#: Maximum pictures per second of a GIF: browsers show no more.
GIF_RATE = 25.0
#: Names of the agents that every task has; see `lag_envs.controllers.KNOW_NOTHING`.
ALL_HAVE = ("zero", "random")


class NamedAgent(NamedTuple):
    """An agent that has a name.

    Attributes
    ----------
    name : str
        Its name.
    about : str
        A short description.
    """

    name: str
    about: str


def named_agents(task: Any, env_id: str) -> list[NamedAgent]:
    """Return the named agents of an environment, the default one first."""
    found = []
    if (own := shipped().get(env_id)) is not None:
        found.append(NamedAgent(own.name, f"comes with the package, score {own.score:.3f}"))
    taken = {agent.name for agent in found}
    controllers = [*task.controllers, *ALL_HAVE]
    if task.reference in controllers:  # a quick one is the default
        controllers.sort(key=lambda name: name != task.reference)
    for name in controllers:
        if name not in taken:
            entry = task.controllers.get(name)
            plans = ", plans for seconds before each episode" if entry is not None and entry.plans else ""
            found.append(NamedAgent(name, f"controller{plans}"))
    return found


def load_agent(env_id: str, task: Any, name: str | None, board: Path | None = None) -> tuple[str, Any]:
    """Return an agent's name, and an object with the `predict` of Stable-Baselines3.

    Parameters
    ----------
    env_id : str
        Id of the environment.
    task : Task
        Its task.
    name : str, optional
        One of `named_agents`, a verified submission of the board by name or id, or the path of a submission's
        folder, of a model of Stable-Baselines3 or `agents.ppo`, or of the folder of its training. The
        default is the first of `named_agents`.
    board : Path, optional
        A board's folder.

    Raises
    ------
    UserError
        If there is no such agent, or it does not fit this environment.
    """
    names = {agent.name.lower(): agent.name for agent in named_agents(task, env_id)}
    name = next(iter(names.values())) if name is None else names.get(name.lower(), name)
    own = shipped().get(env_id)
    if own is not None and name == own.name:
        from lag_envs.leaderboard.shipped import load as load_shipped

        return name, load_shipped(env_id)
    if name in names.values():
        from lag_envs.controllers import build

        return name, build(task, name)
    on_board = _on_board(env_id, board)
    if name in on_board:
        return name, _submission(env_id, on_board[name])
    path = Path(name)
    if not path.exists():
        more = "" if on_board else " (for an agent of a leaderboard, give the board's folder: --board FOLDER)"
        raise UserError(
            f"{env_id} has no agent {name!r}, and there is no such file{more}; "
            f"{hint(name, dict.fromkeys([*names.values(), *on_board]))}"
        )
    folder = path.parent if path.name == "submission.toml" or path.suffix == ".safetensors" else path
    if (folder / "submission.toml").is_file():
        return folder.absolute().name, _submission(env_id, folder)
    return path.name, _model(env_id, task, path)


def _on_board(env_id: str, board: Path | None) -> dict[str, Path]:
    """Return the folders of an environment's verified submissions, by id and by name."""
    if board is None:
        return {}
    from lag_envs.leaderboard.board import Board, BoardError

    try:
        entries = Board(board).read().entries.values()
    except (BoardError, OSError) as error:
        raise UserError(f"{board} cannot be read: {error}") from error
    there = [entry for entry in entries if entry.state == "verified" and entry.env == env_id]
    places = {entry.id: Board(board).submission(entry.id) for entry in there}
    return {entry.name: places[entry.id] for entry in there} | places


def _submission(env_id: str, folder: Path) -> Any:
    """Return the first policy of a submission."""
    from lag_envs.leaderboard.submission import Refused
    from lag_envs.leaderboard.submission import load as load_submission

    try:
        found = load_submission(folder)
    except Refused as error:
        raise UserError(f"{folder}: {error}") from error
    if found.env != env_id:
        raise UserError(f"{folder} is an agent of {found.env}, not of {env_id}")
    return found.policies[0][1].agent()


def _model(env_id: str, task: Any, path: Path) -> Any:
    """Return a network of our own, or a model of Stable-Baselines3, whose loading runs code."""
    from lag_envs.leaderboard import export
    from lag_envs.leaderboard.sb3_models import ModelPolicy

    try:
        source = export.find([path])[0]
        if (of := (source.result or {}).get("env", env_id)) != env_id:
            raise UserError(f"{source.model.parent} is an agent of {of}, not of {env_id}")
        if (network := export.arrays_of(source.model)) is not None:
            return export.own_agent(source, env_id, task, *network)
        import stable_baselines3  # noqa: F401

        model, normalise = export.load_model(source, export.algorithm_of(source))
    except ImportError as error:
        raise UserError(f'{path}: stable-baselines3 is missing: pip install "lag-envs[agents]"') from error
    seen, own = model.observation_space.shape, source.frames * len(task.observation)
    if seen != (own,):
        raise UserError(f"{path} observes {seen} numbers, but {env_id} has {own}")
    return ModelPolicy(model, task, normalise, source.frames)


# --- watching -----------------------------------------------------------------------------------------------


def watch(
    env_id: str,
    agent: Any,
    *,
    seed: int,
    episodes: int | None = None,
    steps: int | None = None,
    video: Path | None = None,
    **options: Any,
) -> list[float]:
    """Show episodes of an agent in a window, or write them into a video; return their returns.

    Parameters
    ----------
    env_id : str
        Id of the environment.
    agent : object
        Anything with the `predict` of Stable-Baselines3.
    seed : int
        Seed of the first episode; later episodes use the numbers that follow.
    episodes : int, optional
        Number of episodes; by default, one in a video, and no limit in a window.
    steps : int, optional
        End after this many steps.
    video : Path, optional
        The file to write, ``.mp4`` or ``.gif``.
    **options
        Keywords of the environment.
    """
    env = gym.make(env_id, render_mode="human" if video is None else "rgb_array", **options)
    if video is None:
        check_display()
    most = 1 if video is not None and episodes is None else episodes
    returns: list[float] = []
    try:
        with recorder(video, 1.0 / env.unwrapped.task.dt) as record:  # type: ignore[attr-defined]
            left = steps
            while (most is None or len(returns) < most) and left != 0:
                total, over, left = _episode(env, agent, seed + len(returns), left, record)
                if over is None:
                    break
                returns.append(total)
                print(f"seed {seed + len(returns) - 1}: {in_words(env_id, total, over)}", flush=True)
    finally:
        env.close()
    return returns


def _episode(
    env: gym.Env, agent: Any, seed: int, left: int | None, record: Any
) -> tuple[float, bool | None, int | None]:
    """Play one episode; return its return, and whether it ran to its end (None: the window was closed)."""
    observation, _ = env.reset(seed=seed)
    state, start, total, over = None, np.ones(1, np.bool_), 0.0, False
    record(env)
    while not over and left != 0:
        action, state = agent.predict(observation, state, start, deterministic=True)
        observation, reward, terminated, truncated, _ = env.step(action)
        total, start = total + float(reward), np.zeros(1, np.bool_)
        over, left = terminated or truncated, None if left is None else left - 1
        if record(env):
            return total, None, left
    return total, over, left


@contextmanager
def recorder(video: Path | None, rate: float) -> Iterator[Any]:
    """Yield a function to call after each step; for a window it returns whether the window was closed."""
    if video is None:
        import pygame

        yield lambda env: not pygame.display.get_init()
        return
    with Video(video, rate) as file:
        yield lambda env: file.add(env.render())


class Video:
    """A video file that is written picture by picture.

    Parameters
    ----------
    path : Path
        The file, ``.mp4`` or ``.gif``.
    rate : float
        Pictures per second.
    """

    def __init__(self, path: Path, rate: float) -> None:
        if path.suffix.lower() not in VIDEOS:
            raise UserError(f"a video's name must end with {' or '.join(VIDEOS)}, got {path}")
        if path.is_dir() or not path.absolute().parent.is_dir():
            raise UserError(
                f"the folder of {path} does not exist" if not path.is_dir() else f"{path} is a folder"
            )
        if not os.access(path if path.exists() else path.absolute().parent, os.W_OK):
            raise UserError(f"{path} cannot be written; choose another place")
        self.path, self.rate = path, rate
        self._gif = path.suffix.lower() == ".gif"
        #: If pictures come faster than they can be shown, only every `every`-th is kept.
        self._every = max(1, round(rate / (GIF_RATE if self._gif else 60.0)))
        self._count = 0
        self._writer: Any = None
        self._pictures: list[Any] = []

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Add a picture."""
        self._count += 1
        if (self._count - 1) % self._every:
            return
        if self._gif:
            from PIL import Image

            self._pictures.append(Image.fromarray(picture).quantize(64))
            return
        if self._writer is None:
            from moviepy.video.io.ffmpeg_writer import FFMPEG_VideoWriter

            height, width = picture.shape[:2]
            self._writer = FFMPEG_VideoWriter(str(self.path), (width, height), self.rate / self._every)
        self._writer.write_frame(picture)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.close()
        if self._pictures:
            first, *others = self._pictures
            hundredths = max(2, round(100.0 * self._every / self.rate))
            first.save(
                self.path,
                save_all=True,
                append_images=others,
                duration=10 * hundredths,
                loop=0,
                optimize=True,
            )
