"""An environment's page, generated from its record: its design, its measurements, derived formulas.

The headings are Gymnasium's. The prose is taken from the docstring, section by section. All tables, numbers
and formulas come from the task, from ``measured.json``, from the board and from the accuracy report.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lag_envs.envs.actions import Actions
from lag_envs.envs.interface import observation_space
from lag_envs.facts import keywords
from lag_envs.leaderboard.docs import plain_markdown
from lag_envs.mechanics.recording import parameter_names
from lag_envs.scenes import Scene
from lag_envs.scenes.declaring import complete
from lag_envs.scenes.derivation import form_of, layout_of
from lag_envs.scores import share_of_privileged
from lag_envs.stepping.series import TOLERANCE
from lag_envs.tables import markdown_table, mean_with_error, number_text, three_digits
from lag_envs.tasks import TASKS
from lag_envs.tasks.base import Task
from lag_envs.tasks.measured import measured_entry
from tools.docs import equations
from tools.docs.markdown import (
    default_text,
    first_line,
    parameter_descriptions,
    sections,
)

ROOT = Path(__file__).parents[2]
HEADINGS = (
    "Description",
    "Action Space",
    "Observation Space",
    "Rewards",
    "Starting State",
    "Episode End",
    "Arguments",
    "Equations",
    "Signs and Units",
    "Numerical Accuracy",
    "Known Returns",
    "Agents",
    "Version History",
)
#: Number of the board's rows that a page shows.
TOP = 3


def environment_page(
    env_id: str, board: Mapping[str, Any] | None = None, accuracy: Mapping[str, Any] | None = None
) -> str:
    """Return the page of an environment.

    Parameters
    ----------
    env_id : str
        Its id.
    board : mapping, optional
        The environment's part of `lag_envs.leaderboard.standings.board_data`.
    accuracy : mapping, optional
        The contents of ``docs/accuracy.json``.
    """
    task: Task = TASKS[env_id]()
    prose = {name: _linked(text) for name, text in sections(type(task)).items()}
    parts: dict[str, list[str]] = {name: [prose.get(name, "")] for name in HEADINGS}
    parts["Description"].append(" ".join(task.difficulty.split()))
    parts["Description"].append(_energy(env_id, task))
    parts["Action Space"].append(_actions(task))
    parts["Observation Space"].append(_observation(task))
    parts["Starting State"].append(_start(task))
    parts["Episode End"].append(_end(task))
    parts["Arguments"] = [arguments(task), prose.get("Arguments", "")]
    parts["Equations"].insert(0, _equations(task))
    parts["Signs and Units"].append(_state(task))
    parts["Numerical Accuracy"].insert(0, _accuracy(env_id, task, accuracy))
    parts["Known Returns"] += [_returns(env_id), _open(env_id)]
    parts["Agents"].append(_agents(env_id, task, board))
    drive = f"[Drive it yourself, and watch its agents](../board/{env_id}.html)."
    lines = [f"# {env_id}", prose[""], _picture(env_id), _summary(env_id, task), drive]
    for heading, texts in parts.items():
        if any(texts):
            lines += [f"## {heading}", *filter(None, texts)]
    return "\n\n".join(filter(None, lines)) + "\n"


def _linked(text: str) -> str:
    """Return a docstring's text with links to the pages that it names."""
    return re.sub(r"docs/(\w+)\.md", lambda name: f"[{name[1].capitalize()}](../{name[0][5:]})", text)


def index() -> str:
    """Return the page of all environments."""
    return f"""# Environments

{overview("{}.md".format)}

Mean return ± standard error of random actions and of the best policy known, as measured by
`python -m agents.scale`.

Actions lie in [-1, 1] and are scaled to the control, or they are choices; exact versions of Gymnasium's
environments have Gymnasium's spaces. Observations are float32, the underlying state is float64.
[Usage](../usage.md#keywords-of-every-environment) lists the keywords that all environments take.
"""


def overview(link: Callable[[str], str]) -> str:
    """Return the table of all environments; `link` returns the address of an id's page."""
    rows = []
    for env_id in TASKS:
        task = TASKS[env_id]()
        found = measured_entry(env_id).get("measured", {})
        best = measured_entry(env_id).get("scale", {}).get("policy", "")
        rows.append(
            [
                f"[{env_id}]({link(env_id)})",
                first_line(type(task)),
                "; ".join(_range(acting) for acting in task.formulas.acting),
                *(
                    mean_with_error(row["mean"], row["error"]) if row else "not measured yet"
                    for row in map(found.get, ("random", best))
                ),
            ]
        )
    return markdown_table(["environment", "what to do", "control", "random", "best known"], rows)


def by_scene(source: Callable[[str], str]) -> str:
    """Return a short table of scenes and their tasks' ids; `source` gives the address of an id's file."""
    files: dict[str, list[str]] = {}
    for env_id in TASKS:
        files.setdefault(source(env_id), []).append(env_id)
    rows = []
    for file, ids in files.items():
        scenes = dict.fromkeys(TASKS[env_id].scene for env_id in ids)
        named = ", ".join(f"`{kind.__name__}`" for kind in scenes)
        rows.append(
            [f"[{named}]({file})", "; ".join(map(first_line, scenes)), ", ".join(f"`{i}`" for i in ids)]
        )
    return markdown_table(["scene", "", "environments"], rows)


def _range(acting: Any) -> str:
    """Return a control's values in words."""
    if acting.values:
        return f"`{acting.control}` {', '.join(map(number_text, acting.values))} {acting.unit}"
    if acting.low == -acting.high:
        return f"`{acting.control}` ±{number_text(acting.high)} {acting.unit}"
    return f"`{acting.control}` {number_text(acting.low)} to {number_text(acting.high)} {acting.unit}"


# --- parts of a page ----------------------------------------------------------------------------------------


def _picture(env_id: str) -> str:
    if not (ROOT / "docs" / "images" / "moving" / f"{env_id}.webp").exists():
        return ""
    return f"![{env_id}: a trained agent at work](../images/moving/{env_id}.webp)"


def _energy(env_id: str, task: Task) -> str:
    if not (ROOT / "docs" / "images" / f"energy-{env_id}.png").exists():
        return ""
    return (
        f"![Energy less work against time in {task.peer} and "
        f"{env_id}](../images/energy-{env_id}.png)\n\nThe picture shows the energy minus the work done by "
        "the control, under random actions from a start in mid-motion. There is no friction, so this "
        "difference must stay constant."
    )


def _summary(env_id: str, task: Task) -> str:
    spaces = Actions(task.formulas).space, observation_space([task])
    shown = [str(space) if not hasattr(space, "low") else _box(space) for space in spaces]
    rows = [
        ["Make it", f'`gym.make("{env_id}")`, `gym.make_vec("{env_id}", num_envs=64)`'],
        ["Action space", f"`{shown[0]}`"],
        ["Observation space", f"`{shown[1]}`"],
        ["Step, episode", f"{number_text(task.dt)} s, {number_text(task.limit)} steps"],
    ]
    return markdown_table(rows[0], rows[1:])


def _box(space: Any) -> str:
    """Return a box, without its bounds if they differ, as the table below has them."""
    ends = {float(x) for x in space.low}, {float(x) for x in space.high}
    if all(len(end) == 1 for end in ends):
        return (
            f"Box({number_text(ends[0].pop())}, {number_text(ends[1].pop())}, {space.shape}, {space.dtype})"
        )
    return f"Box({space.shape}, {space.dtype})"


def _actions(task: Task) -> str:
    rows = []
    for i, acting in enumerate(task.formulas.acting):
        ends = acting.values or (acting.low, acting.high)
        values = [", ".join(map(number_text, ends)), ""] if acting.values else [*map(number_text, ends)]
        _, meaning = task.quantities.get(acting.control, ("", ""))
        rows.append([str(i), f"`{acting.control}`", meaning, acting.unit, *values])
    top = task.formulas.largest
    listed = any(acting.values for acting in task.formulas.acting)
    head = [
        "Num",
        "Control",
        "Meaning",
        "Unit",
        *(("Values, by action", "") if listed else (f"At {number_text(-top)}", f"At {number_text(top)}")),
    ]
    return markdown_table(head, rows)


def _observation(task: Task) -> str:
    space = observation_space([task])
    known = dict(zip(task.scene.state_names, task.scene.state_units, strict=True))
    known |= {target.name: target.unit for target in task.formulas.target_boxes}
    rows = []
    for i, (name, low, high) in enumerate(zip(task.observation, space.low, space.high, strict=True)):
        unit, meaning = task.quantities.get(name, (known.get(name, ""), ""))
        rows.append([str(i), f"`{name}`", meaning, unit, _bound(low), _bound(high)])
    return markdown_table(["Num", "Observation", "Meaning", "Unit", "Min", "Max"], rows)


def _bound(value: Any) -> str:
    """Return a bound with four digits; the largest float32 means no bound."""
    if abs(value) >= np.finfo(np.float32).max:
        return "-∞" if value < 0 else "∞"
    return f"{float(value):.4g}"


def _start(task: Task) -> str:
    names = zip(task.scene.state_names, task.scene.state_units, task.centre, task.half_widths, strict=True)
    rows = [[f"`{name}`", unit, number_text(centre), number_text(half)] for name, unit, centre, half in names]
    targets = task.formulas.target_boxes
    rows += [[f"`{t.name}` (target)", t.unit, number_text(t.centre), number_text(t.half)] for t in targets]
    given = f'"state": [{", ".join(task.scene.state_names)}]'
    if targets:
        given += ', "target": ' + (
            targets[0].name if len(targets) == 1 else f"[{', '.join(t.name for t in targets)}]"
        )
    text = f"Each entry is drawn uniformly. `reset(options={{{given}}})` sets them."
    return f"{text}\n\n{markdown_table(['Entry', 'Unit', 'Centre', 'To either side'], rows)}"


def _end(task: Task) -> str:
    return f"Truncation: after {number_text(task.limit)} steps ({number_text(task.duration)} s)."


def arguments(task: Task) -> str:
    """Return the table of an environment's keywords."""
    words = parameter_descriptions(type(task.scene))
    rows = [
        [f"`{name}`", default_text(value), unit, within, meaning or words.get(name, "")]
        for name, value, unit, within, meaning in keywords(task)
    ]
    also = (
        'Also `render_mode` ("human" or "rgb_array"), and `diagnostics=True`, which puts controls, forces '
        "and energy into `info`; and the keywords of [imperfect sensors and actuators and hidden "
        "parameters](../usage.md#imperfect-sensors-and-actuators)"
    )
    own = ", ".join(f"`{name}={value!r}`" for name, value in type(task).imperfections.items())
    also += f", of which {own} are on here." if own else "."
    return f"{markdown_table(['Keyword', 'Default', 'Unit', 'Range', 'Meaning'], rows)}\n\n{also}"


def keyword_fields(kind: type[Scene]) -> list[Any]:
    """Return the fields that are keywords of a scene."""
    complete(kind)
    return [field for field in dataclasses.fields(kind) if field.init]  # type: ignore[arg-type]


@cache
def _derived(kind: type[Scene], choices: tuple[tuple[str, Any], ...]) -> tuple[str, ...]:
    scene = kind(**dict(choices))
    return equations.lagrangian_expression(scene), *equations.lagrange_equations(scene)


def derivation(scene: Scene) -> str:
    """Return a scene's Lagrangian and the equations of motion that follow from it."""
    kind, symbols = type(scene), parameter_names(scene)
    choices = ((f.name, getattr(scene, f.name)) for f in keyword_fields(kind) if f.name not in symbols)
    lagrangian, *motion = map(equations.formula_mathml, _derived(kind, tuple(choices)))
    return "\n\n".join(["The Lagrangian, T - V:", lagrangian, "and the equations of motion:", *motion])


def _equations(task: Task) -> str:
    text = derivation(task.scene)
    if len(layout_of(task.scene).free) == 1:
        numbers = equations.formula_mathml(equations.with_numbers(task.scene))
        text += f"\n\nWith the default parameters, in SI units:\n\n{numbers}"
    return text


def _state(task: Task) -> str:
    pairs = zip(task.scene.state_names, task.scene.state_units, strict=True)
    listed = ", ".join(f"`{name}` [{unit}]" for name, unit in pairs)
    return f"State, float64, `env.unwrapped.state`: {listed}."


def _accuracy(env_id: str, task: Task, accuracy: Mapping[str, Any] | None) -> str:
    form, speed, texts = form_of(task.scene), task.certified_speed(), []
    if form and speed is None:
        texts.append(f"Stepped by an exact flow ({form.flow(task.dt).method}).")
    elif form and speed < 0.0:
        texts.append(
            f"Stepped by Taylor series of order {form.order(task.dt)}. With some controls one series is "
            "never enough, and the step is divided into parts by the proved bound."
        )
    elif form:
        order = task.scene.step_bound(task.centre, task.limit_control, task.dt).order
        rate = f"{layout_of(task.scene).free[0]}_dot"
        texts.append(
            f"Stepped by a Taylor series of order {order}. One series per step is certified to have a "
            f"truncation error of at most 1e-12 rad/s as long as |`{rate}`| is at most "
            f"{math.floor(10.0 * speed) / 10.0:.1f} rad/s, whatever the control. Above this speed, the step "
            "is divided into parts by the same bound."
        )
    else:
        texts.append(
            "Stepped by Taylor series, each with a proved bound on its truncation error. If the bound "
            f"exceeds {TOLERANCE:.0e} of the velocities' size, the step is divided. If dividing does not "
            "help, for example with a link of a millimetre, an error names state and control, and the "
            "state is kept."
        )
    for row in _summary_rows(accuracy):
        if row["environment"] == env_id:
            texts.append(
                "Measured against 40-digit arithmetic, over whole episodes of random actions: the largest "
                f"error of a single step is {row['one step']:.1e} of the state's size. The largest error of "
                f"an episode is {row['whole episode']:.1e}, which is "
                f"{three_digits(row['error / rounding floor'])} times one rounding of the start, as "
                "amplified by the system. See [Accuracy](../accuracy.md)."
            )
    return "\n\n".join(texts)


def _summary_rows(accuracy: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    for part in (accuracy or {}).get("sections", ()):
        if part["name"] == "environments":
            return [
                dict(zip(part["summary"]["columns"], row, strict=True)) for row in part["summary"]["rows"]
            ]
    return []


def _returns(env_id: str) -> str:
    found = measured_entry(env_id)
    if not found:
        return "Not measured yet."
    best = found["scale"]["policy"]
    names = {
        "random": "random actions",
        "zero": "zero control",
        best: f"{best}, the best policy known when the protocol began",
    }
    names["optimum"] = f"the optimum: {TASKS[env_id].optimum.text}" if TASKS[env_id].optimum else ""
    names["privileged"] = f"a reference that {TASKS[env_id].open.knows}" if TASKS[env_id].open else ""
    rows = [
        [
            text,
            mean_with_error(row["mean"], row["error"]),
            f"{row['episodes']:,}" if "episodes" in row else "",
        ]
        for name, text in names.items()
        if (row := found["measured"].get(name))
    ]
    text = "Mean return ± standard error, as measured by `python -m agents.scale`:"
    return f"{text}\n\n{markdown_table(['Policy', 'Return', 'Episodes'], rows)}"


def _open(env_id: str) -> str:
    """Return the statement that nobody has solved the task, and the list of attempts."""
    task = TASKS[env_id]
    if task.open is None:
        return ""
    share, found = share_of_privileged(env_id), measured_entry(env_id).get("measured", {})
    text = "**This task is open.** "
    if share is not None:
        text += (
            f"The best attempt gets {100.0 * share:.0f} % of the return of a reference that "
            f"{task.open.knows}. "
        )
    rows = [
        [name, budget, mean_with_error(row["mean"], row["error"]) if (row := found.get(name)) else ""]
        for name, budget in task.open.tried.items()
    ]
    return f"{text}Tried so far:\n\n{markdown_table(['Method', 'Budget', 'Return'], rows)}"


def _agents(env_id: str, task: Task, board: Mapping[str, Any] | None) -> str:
    texts = [task.note.strip()] if task.note else []
    if board and board["rows"]:
        ranked = [row for row in board["rows"] if row["rank"] is not None][:TOP]
        rows = [
            [
                str(row["rank"]),
                plain_markdown(row["name"]),
                row["kind"],
                f"{row['score']:.4f}",
                _interval(row),
            ]
            for row in ranked
        ]
        texts += [
            "The top of the leaderboard (score 0 is random actions, 1 the best policy known when the "
            "protocol began):",
            markdown_table(["Rank", "Agent", "Kind", "Score", "95 % interval"], rows),
            f"[The board](../board/{env_id}.html) has the whole ranking. "
            f"[Agents](../agents.md#{env_id.lower()}) has their robustness and learning curves.",
        ]
    elif task.goal:
        texts.append(f"[Its board](../board/{env_id}.html) has no entries yet.")
    return "\n\n".join(texts)


def _interval(row: Mapping[str, Any]) -> str:
    low, high = row["interval"]
    return f"{low:.4f} to {high:.4f}"


# --- sources of the pages -----------------------------------------------------------------------------------


def pages(data: Mapping[str, Any], root: Path = ROOT, env_ids: Iterable[str] = TASKS) -> dict[str, str]:
    """Return pages of environments by id, from a checkout.

    Parameters
    ----------
    data : mapping
        The result of `lag_envs.leaderboard.standings.board_data`.
    root : Path, optional
        The checkout.
    env_ids : iterable of str, optional
        Ids of the environments; all by default.
    """
    accuracy = json.loads((root / "docs" / "accuracy.json").read_text(encoding="utf-8"))
    boards = {one["id"]: one for one in data["environments"] if not one["frozen"]}
    return {env_id: environment_page(env_id, boards.get(env_id), accuracy) for env_id in env_ids}
