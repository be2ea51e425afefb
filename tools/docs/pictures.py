"""Moving pictures of the environments: a recorded episode of the board's best agent, as WebP."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lag_envs.envs.rendering import Viewer
from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.standings import board_data
from lag_envs.tasks import TASKS

#: Frames per second, and the largest file [bytes].
RATE, LARGEST = 15, 300_000
#: If a learned agent's score is above this, it is shown instead of the best agent of all.
GOOD = 0.8
#: Widths [pixels], qualities, and strides of frames; the first combination with a small enough file is used.
CHOICES = ((480, 60, 1), (480, 40, 1), (400, 40, 1), (360, 30, 1), (360, 30, 2), (320, 20, 3))


def draw_environments(board: Path, folder: Path, envs: Collection[str]) -> None:
    """Draw environments of a board: with the best learned agent if it is good, otherwise the best of all."""
    folder.mkdir(parents=True, exist_ok=True)
    for found in board_data(Board(board))["environments"]:
        rows = [row for row in found["rows"] if row["replays"] and row["rank"] is not None]
        learned = [row for row in rows if row["kind"] == "learned" and row["score"] >= GOOD]
        if not found["frozen"] and rows and found["id"] in envs:
            row = (learned or rows)[0]
            path = folder / f"{found['id']}.webp"
            write_animation(path, *frames(found["id"], row["replays"][0]))
            print(f"{path.name}: {row['name']}, {path.stat().st_size:,} bytes")


def frames(env_id: str, replay: Mapping[str, Any]) -> tuple[list[Image.Image], float]:
    """Return frames of a recorded episode, and the seconds between them."""
    task = TASKS[env_id]()
    viewer = Viewer(task, "rgb_array")
    controls = task.wanted(replay["actions"])
    every = max(1, round(1.0 / (RATE * task.dt)))
    target = replay.get("target")
    pictures = []
    for i, state in enumerate(replay["states"]):
        control = controls[min(i, len(controls) - 1)]
        picture = viewer.draw(
            np.array(state, np.float64), control if len(control) > 1 else float(control[0]), target
        )
        if i % every == 0 and picture is not None:
            pictures.append(Image.fromarray(picture))
    return pictures, every * task.dt


def write_animation(path: Path, pictures: list[Image.Image], seconds: float) -> None:
    """Write an animation that loops, in the best quality that fits the size limit."""
    for width, quality, every in CHOICES:
        size = width, round(pictures[0].height * width / pictures[0].width)
        first, *rest = (picture.resize(size, Image.Resampling.LANCZOS) for picture in pictures[::every])
        first.save(
            path, save_all=True, append_images=rest, duration=round(1000 * seconds * every), loop=0,
            quality=quality, method=3,
        )  # fmt: skip
        if path.stat().st_size <= LARGEST:
            return
