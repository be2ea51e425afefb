"""A template of a scene and a task; the command ``lag-envs new``."""

from __future__ import annotations

import keyword
import re
from importlib.util import find_spec
from pathlib import Path

from lag_envs.errors import UserError
from lag_envs.store import write_file

TEMPLATE = Path(__file__).with_name("starter.py.txt")


def start(path: Path) -> Path:
    """Write a scene and a task into a new file, and return its path.

    Raises
    ------
    UserError
        If the file already exists or cannot be written, or if Python cannot import a module of that name.
    """
    if path.suffix != ".py":
        raise UserError(f"{path}: the file's name must end with .py, as in {path.stem or 'my_scene'}.py")
    if path.exists() or path.is_symlink():
        raise UserError(f"{path} already exists; choose another name, or remove it first")
    if not path.stem.isidentifier() or keyword.iskeyword(path.stem):
        raise UserError(f"{path}: the name must be one that Python can import, such as my_scene.py")
    if find_spec(path.stem) is not None:
        raise UserError(f"{path}: the file would hide an installed module of this name; choose another name")
    if not path.absolute().parent.is_dir():
        raise UserError(f"there is no folder {path.absolute().parent}")
    try:
        write_file(path, filled(path.stem))
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}") from error
    return path


def filled(module: str) -> str:
    """Return the template, filled in for a module's name.

    Examples
    --------
    >>> [line for line in filled("my_scene").splitlines() if line.startswith("class ")]
    ['class MyScene(Scene):', 'class SwingUp(Task):']
    """
    name = "".join(part[:1].upper() + part[1:] for part in module.split("_")) or "Own"
    text = TEMPLATE.read_text(encoding="utf-8")
    # The scene must not have the name of anything else in the file.
    scene = f"{name}Scene" if re.search(rf"(import|class).*\b{name}\b", text) else name
    for mark, value in (("SCENE", scene), ("NAME", name), ("MODULE", module), ("FILE", f"{module}.py")):
        text = re.sub(rf"\b{mark}\b", value, text)
    return text
