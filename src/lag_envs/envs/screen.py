"""The window on the screen, which all viewers of a process share."""

from __future__ import annotations

import contextlib
import math
import os
import weakref
from functools import cache
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from gymnasium.error import DependencyNotInstalled, Error
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pygame


#: What to do without a window.
REMEDY = '`lag-envs watch ID --video FILE` writes a video, render_mode="rgb_array" gives pictures'


@cache
def load_pygame() -> Any:
    """Return pygame, or raise an error that tells how to install it."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame
    except ImportError as error:
        raise DependencyNotInstalled(
            'windows and the read-out need pygame: pip install "lag-envs[render]"'
        ) from error
    return pygame


class Shown(Protocol):
    """An object that a window shows; it has a size."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture [pixels]."""


class Desk:
    """Keeps the window, and the places of the viewers in it."""

    def __init__(self) -> None:
        # These references are weak, so that an environment dropped without being closed does not keep its
        # place.
        self._viewers: weakref.WeakKeyDictionary[Shown, None] = weakref.WeakKeyDictionary()
        self._screen: pygame.Surface | None = None
        self._places = 0

    def __contains__(self, viewer: Shown) -> bool:
        return viewer in self._viewers

    def add(self, viewer: Shown) -> None:
        """Make room for a viewer."""
        # Finalizers registered first run last: by then the viewer has left the list.
        weakref.finalize(viewer, self._tidy)
        self._viewers[viewer] = None

    def remove(self, viewer: Shown) -> None:
        """Remove a viewer's picture; the last viewer closes the window."""
        self._viewers.pop(viewer, None)
        self._tidy()

    def _tidy(self) -> None:
        """Close the window if no viewer is left, as at the end of the program."""
        if self._screen is not None and not self._viewers:
            self._close()

    def show(self, viewer: Shown, picture: NDArray[np.uint8]) -> None:
        """Show a viewer's picture, and close the window if its user asks for it."""
        pygame, places = load_pygame(), list(self._viewers)
        columns, (width, height) = math.ceil(math.sqrt(len(places))), viewer.size
        # There is also no surface if another part of the program has closed all windows.
        if self._screen is None or self._places != len(places) or pygame.display.get_surface() is None:
            rows = math.ceil(len(places) / columns)
            self._screen, self._places = _open_window(columns * width, rows * height), len(places)
        row, column = divmod(places.index(viewer), columns)
        surface = pygame.image.frombuffer(picture, (width, height), "RGB")
        self._screen.blit(surface, (column * width, row * height))
        pygame.display.flip()
        pygame.event.pump()
        # Only this event is taken from the queue, so that a program can read keys.
        if pygame.event.get(pygame.QUIT):
            self._viewers.clear()
            self._close()

    def _close(self) -> None:
        self._screen = None
        load_pygame().display.quit()


def _open_window(width: int, height: int) -> pygame.Surface:
    pygame = load_pygame()
    try:
        pygame.display.init()
        screen = pygame.display.set_mode((width, height))
    except pygame.error as error:
        raise Error(f"no window can be opened ({error}); {REMEDY}") from error
    pygame.display.set_caption("lag_envs")
    return screen


def check_display() -> None:
    """Raise an error if SDL would open a window that nobody can see, unless the user asks for this."""
    pygame = load_pygame()
    with contextlib.suppress(pygame.error):  # opening a window then raises an error with the reason
        pygame.display.init()
        unseen = pygame.display.get_driver() in ("offscreen", "dummy")
        if unseen and not os.environ.get("SDL_VIDEODRIVER"):
            pygame.display.quit()
            raise Error(f"no display was found; {REMEDY}")


desk = Desk()
