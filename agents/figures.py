"""Figures of the agents' results: scores, learning curves, conditions, probabilities of improvement."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.analysis import Data
from agents.learners import learner_label
from agents.report import brief, meaningful_digits
from lag_envs.evaluation.conditions import NOMINAL, OFTEN

#: Okabe and Ito's colours, which colour-blind readers can tell apart.
COLOURS = {"learned": "#0072B2", "classical": "#D55E00", "optimal": "#000000"}
MARKS = {"learned": "o", "classical": "s", "optimal": "D"}
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
#: Scores below this are drawn at the edge, with the score as a number.
LOWEST = -0.1


def figures(data: Data, folder: Path) -> list[Path]:
    """Draw all figures into a folder and return their files."""
    envs = data["envs"]
    drawn = {"agents-scores.png": scores_figure(envs)}
    if any(agent["kind"] == "learned" for env in envs.values() for agent in env["agents"].values()):
        drawn["agents-steps.png"] = curves_figure(envs, "steps")
        drawn["agents-seconds.png"] = curves_figure(envs, "seconds")
    if any(env["improvement"] for env in envs.values()):
        drawn["agents-improvement.png"] = improvement_figure(envs)
    for env_id, env in envs.items():
        drawn[f"agents-robustness-{env_id}.png"] = robustness_figure(env_id, env)
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in drawn.items():
        save(figure, folder / name)
    return [folder / name for name in drawn]


def save(figure: Any, file: Path) -> None:
    """Write a figure as a PNG of few colours, which is a third as large."""
    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    Image.open(buffer).convert("RGB").quantize(16).save(file, optimize=True)


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _panels(
    envs: Mapping[str, Data], heights: Sequence[float] | None = None, columns: int = 2
) -> tuple[Any, list[Any]]:
    """Return a figure and a panel for each environment; several panels share a row."""
    tall = heights or [5.2 / columns] * len(envs)
    ratios = [max(tall[i : i + columns]) for i in range(0, len(envs), columns)]
    figure = _figure(10.0, sum(ratios) + 0.3)
    axes = figure.subplots(len(ratios), columns, squeeze=False, gridspec_kw={"height_ratios": ratios}).ravel()
    for ax in axes[len(envs) :]:
        ax.remove()
    for ax, env_id in zip(axes, envs, strict=False):
        ax.set_title(env_id, fontsize=10)
        ax.tick_params(labelsize=8)
    return figure, list(axes[: len(envs)])


def _what(env: Data) -> str:
    return "score" if env["known"] else "mean return"


def scores_figure(envs: Mapping[str, Data]) -> Any:
    """Draw each agent's result, and next to it the result when the agent acts ten times as often."""
    figure, axes = _panels(envs, [0.9 + 0.3 * len(env["agents"]) for env in envs.values()])
    for ax, env in zip(axes, envs.values(), strict=True):
        lowest = LOWEST if env["known"] else _lowest(env["agents"])
        shown = env["agents"].values()
        for row, agent in enumerate(shown):
            colour = COLOURS[agent["kind"]]
            for name, shift, face in ((NOMINAL, -0.14, colour), (OFTEN, 0.14, "white")):
                found = agent["conditions"].get(name)
                if found is None:
                    continue
                value = max(found["value"], lowest)
                if value > lowest:
                    ends = [max(found["low"], lowest), found["high"]]
                    ax.plot(ends, [row + shift] * 2, "-", color=colour, lw=1.2)
                    ax.plot(value, row + shift, MARKS[agent["kind"]], color=colour, mfc=face, ms=5)
                else:
                    text = f"◂ {meaningful_digits(found['value'])}{'' if name == NOMINAL else ' (often)'}"
                    ax.text(lowest, row + shift, text, va="center", fontsize=7, color=colour)
        names = [brief(name, agent) for name, agent in env["agents"].items()]
        ax.set_yticks(range(len(names)), names, fontsize=8)
        ax.set_ylim(len(env["agents"]) - 0.5, -0.5)
        ax.set_xlabel(_what(env), fontsize=8)
        if lowest > -math.inf:
            ax.set_xlim(left=lowest)
        if env["known"]:
            values = [
                a["conditions"].get(c, {"value": 0.0})["value"] for a in shown for c in (NOMINAL, OFTEN)
            ]
            ax.set_xlim(lowest, max(1.02, *values) + 0.03)
            ax.axvline(1.0, color="0.6", lw=0.8)
        ax.grid(axis="x", color="0.9")
    styles = [{"marker": MARKS[kind], "color": colour, "label": kind} for kind, colour in COLOURS.items()]
    styles.append({"marker": "o", "color": "0.3", "mfc": "white", "label": "open: ten times as often"})
    _legend(figure, [{"ls": ""} | style for style in styles])
    return figure


def _lowest(agents: Mapping[str, Data]) -> float:
    """Return the return below which agents are drawn at the edge."""
    values = {name: agent["conditions"][NOMINAL]["value"] for name, agent in agents.items()}
    low, high = values.get("random", -math.inf), max(values.values())
    return low + LOWEST * (high - low) if low < high else -math.inf


def curves_figure(envs: Mapping[str, Data], over: str) -> Any:
    """Draw learners' results over the steps, or the seconds, of training."""
    shown = {i: e for i, e in envs.items() if any(a["kind"] == "learned" for a in e["agents"].values())}
    names = sorted({n for e in shown.values() for n, a in e["agents"].items() if a["kind"] == "learned"})
    styles = {
        name: {"color": LINES[i % len(LINES)], "ls": ["-", "--", "-."][i % 3], "label": learner_label(name)}
        for i, name in enumerate(names)
    }
    figure, axes = _panels(shown, columns=3)
    for ax, env in zip(axes, shown.values(), strict=True):
        for name, style in styles.items():
            curve = (env["agents"].get(name, {}).get("curves") or {}).get(over)
            if curve is None:
                continue
            x = np.array(curve["x"]) / (1e3 if over == "steps" else 1.0)
            ax.plot(x, curve["value"], lw=1.5, **style)
            if curve["low"] is not None:
                ax.fill_between(x, curve["low"], curve["high"], color=style["color"], alpha=0.2, lw=0)
        if env["known"]:
            ax.set_ylim(LOWEST, 1.05)
            ax.axhline(1.0, color="0.6", lw=0.8)
        ax.set_xlabel("steps of the environment [thousands]" if over == "steps" else "time [s]", fontsize=8)
        ax.set_ylabel(_what(env), fontsize=8)
        ax.grid(color="0.9")
    _legend(figure, list(styles.values()))
    return figure


def robustness_figure(env_id: str, env: Data) -> Any:
    """Draw each agent's result under each condition, as a table with colours."""
    agents = env["agents"]
    most = max((agent["conditions"] for agent in agents.values()), key=len)
    columns = list(dict.fromkeys([*most, *(c for agent in agents.values() for c in agent["conditions"])]))
    values = np.array(
        [[a["conditions"].get(c, {}).get("value", math.nan) for c in columns] for a in agents.values()]
    )
    low, high = (0.0, 1.0) if env["known"] else (float(np.nanmin(values)), float(np.nanmax(values)))
    figure = _figure(1.6 + 0.52 * len(columns), 1.5 + 0.3 * len(agents))
    ax = figure.subplots()

    def text(value: float) -> str:
        return (f"{value:.2f}" if abs(value) < 10.0 else f"{value:.0f}").replace("-0.00", "0.00")

    _heat(ax, values, low, high, text)
    ax.set_xticks(range(len(columns)), columns, rotation=45, ha="right", rotation_mode="anchor", fontsize=8)
    ax.set_yticks(range(len(agents)), [brief(name, agent) for name, agent in agents.items()], fontsize=8)
    ax.set_title(f"{env_id}: {_what(env)}", fontsize=10)
    return figure


def improvement_figure(envs: Mapping[str, Data]) -> Any:
    """Draw how likely a run of one learner is to be better than another agent."""
    shown = {env_id: env for env_id, env in envs.items() if env["improvement"]}
    figure, axes = _panels(shown, [1.4 + 0.3 * len(env["improvement"]) for env in shown.values()])
    for ax, env in zip(axes, shown.values(), strict=True):
        # Every agent that learned anything is better than no control and random control.
        named = ((name, brief(name, agent)) for name, agent in env["agents"].items())
        names = {name: short for name, short in named if name not in ("zero", "random")}
        rows = [names[row] for row in env["improvement"]]
        values = np.array(
            [[r.get(c, {}).get("value", math.nan) for c in names] for r in env["improvement"].values()]
        )
        _heat(ax, values, 0.0, 1.0, lambda p: f"{p:.2f}" if 0.0 < p < 1.0 else "")
        angle: Any = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"}
        ax.set_xticks(range(len(names)), names.values(), fontsize=7, **angle)
        ax.set_yticks(range(len(rows)), rows, fontsize=8)
    figure.supylabel("probability (dark: 0, bright: 1) that a run of this ...", fontsize=9)
    figure.supxlabel("... is better than this", fontsize=9)
    return figure


def _heat(ax: Any, values: NDArray, low: float, high: float, text: Callable[[float], str]) -> None:
    """Draw numbers as a table with colours; unknown ones are grey."""
    ax.set_facecolor("0.85")
    ax.imshow(values, cmap="cividis", vmin=low, vmax=high, aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        if not math.isnan(value):
            colour = "black" if value > low + 0.55 * (high - low) else "white"
            ax.text(j, i, text(value), ha="center", va="center", fontsize=7, color=colour)


def _legend(figure: Any, styles: Sequence[dict[str, Any]]) -> None:
    from matplotlib.lines import Line2D

    keys = [Line2D([], [], **style) for style in styles]
    figure.legend(handles=keys, loc="outside lower center", ncols=len(keys), fontsize=8, frameon=False)
