"""The page of all scenes, generated from their classes."""

from __future__ import annotations

import inspect
import re
import sys

from lag_envs.mechanics.recording import parameter_names
from lag_envs.scenes import SCENES, Scene
from lag_envs.tables import markdown_table
from tools.docs.environments import derivation, keyword_fields
from tools.docs.equations import formula_mathml, symbol
from tools.docs.markdown import default_text, first_line, parameter_descriptions


def scenes_page() -> str:
    """Return the page."""
    parts = [
        "# Scenes",
        "A scene states its kinetic and potential energy, its drag and its applied forces. Everything on "
        "this page follows from them: SymPy derives the formulas below from the same energies that are "
        "stepped. [Physics](physics.md) says more about the first three scenes, and [the "
        "tutorial](tutorial.md) shows how to write a scene.",
        markdown_table(["scene", "", "state", "control"], [_row(kind) for kind in SCENES]),
    ]
    for kind in SCENES:
        parts += [f"## {kind.__name__}", *_scene(kind)]
    return "\n\n".join(parts) + "\n"


def _row(kind: type[Scene]) -> list[str]:
    scene = kind()
    return [
        f"[{kind.__name__}](#{kind.__name__.lower()})",
        first_line(kind),
        ", ".join(f"`{name}`" for name in scene.state_names),
        ", ".join(f"`{name}`" for name in scene.control_names),
    ]


def _scene(kind: type[Scene]) -> list[str]:
    scene, words = kind(), parameter_descriptions(kind)
    rows = []
    for field in keyword_fields(kind):
        letter = (
            formula_mathml(symbol(kind, field.name), block=False)
            if field.name in parameter_names(scene)
            else ""
        )
        default = default_text(getattr(scene, field.name))
        rows.append(
            [f"`{field.name}`", letter, default, field.metadata.get("unit", ""), words.get(field.name, "")]
        )
    units = zip(scene.control_names, scene.control_units, strict=True)
    return [
        f"{first_line(kind)}.",
        f"```text\n{_drawing(kind)}\n```",
        _notes(kind),
        f"Controls: {', '.join(f'`{name}` [{unit}]' for name, unit in units)}.",
        markdown_table(["parameter", "symbol", "default", "unit", "meaning"], rows),
        derivation(scene),
        f"[API](api/scenes.md#lag_envs.scenes.{kind.__name__})",
    ]


def _drawing(kind: type[Scene]) -> str:
    """Return the drawing at the head of the scene's file."""
    text = sys.modules[kind.__module__].__doc__ or ""
    drawing = re.search(r"^::\n\n((?:[ ]{4}[^\n]*\n|\n)+)", text, re.MULTILINE)
    return inspect.cleandoc("\n" + drawing[1]) if drawing else ""


def _notes(kind: type[Scene]) -> str:
    text = inspect.getdoc(kind) or ""
    notes = re.search(r"^Notes\n-+\n(.*?)(?=^\w[^\n]*\n-+\n|\Z)", text, re.MULTILINE | re.DOTALL)
    return notes[1].strip().replace("``", "`") if notes else ""
