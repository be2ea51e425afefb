"""Results on the errors of whole episodes: tables, pictures, claims."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from statistics import median

from matplotlib.figure import Figure

from lag_envs.report.content import Claim, Content, ReportFigure, Table
from lag_envs.report.episodes import DIGITS, TIMES
from lag_envs.report.gymnasium_peers import PEERS
from lag_envs.report.runner import JobResult, Row
from lag_envs.scenes.derivation import form_of
from lag_envs.stepping.series import TOLERANCE
from lag_envs.tasks import TASKS

#: Limits on the error of an exact flow's step and of its episode, and on that of any episode: a multiple of
#: one rounding of its start, as amplified by the system, or the sum of the series' truncation errors.
LARGEST_STEP, LARGEST_ERROR, ROUNDINGS = 1e-15, 1e-13, 100.0
#: The accuracy that any scene promises of a step. The certificate requires less truncation error, but
#: measures a velocity by energy, and a light body's velocity may be small compared to that measure.
PROMISED = 1e-12
APART = 1e9  #: Factor by which Gymnasium's errors should at least exceed those of lag_envs.
#: The undriven pendulum is released at rest, this far from hanging [rad]. Its angle is compared over the
#: first time, its energy over the second time [s].
RELEASED, COMPARED, LONG = 2.5, 10.0, 100.0
MARKS = ("one step", *(f"{t:g} s" for t in TIMES), "the end")
BLUE, GREY = "#0072b2", "#666666"


def content(rows: list[Row], problems: list[JobResult]) -> Content:
    """Return the section's content."""
    cases = {case: [r for r in rows if r["case"] == case] for case in dict.fromkeys(r["case"] for r in rows)}
    episodes = {case: group for case, group in cases.items() if group[0]["seed"] is not None}
    free = [r for r in rows if r["seed"] is None]
    failed = {result.name: result.problem or "" for result in problems}
    pictures = []
    if episodes:
        pictures = [
            ReportFigure(
                "environment-errors",
                "Error of whole episodes (the first 1,000 steps of longer ones), relative to the size of "
                "the state, as the largest up to a time. There is one line per episode, and for "
                "CartPole-v1 a second line for its update continued past the end. The exact states are "
                "computed to more than 30 digits. Dotted, in the same colours: one rounding of the start, "
                "propagated in exact arithmetic.",
                lambda: _draw_all(episodes),
            ),
            ReportFigure(
                "environment-errors-each",
                "The same, environment by environment. Solid: error of an episode. Dotted: one rounding of "
                "its start, amplified by the system itself.",
                lambda: _draw_each(episodes),
            ),
        ]
    return Content(
        "Environments over whole episodes",
        _text(),
        [_cases_table(episodes, failed), _entries_table(cases), *([_free_table(free)] if free else [])],
        pictures,
        _claims(rows),
        _summary(episodes),
        [_details(rows)] if rows else [],
    )


def _text() -> list[str]:
    return [
        "Episodes are recorded from gym.make under random actions: float64 states, and the controls that "
        "were applied. The exact motion has the same start and the same controls, without rounding in "
        f"between. The oracle computes it with {DIGITS} digits, and for the first seed of lag_envs's own "
        f"again with {DIGITS + 12}. If a task has random kicks, they are computed by the task's own formula "
        "from the environment's own random numbers, without rounding.",
        "Gymnasium's environments have the equations of scenes with the parameters of each instance. They "
        "clip velocities; episodes in which this happens are left out, and the next seed is taken. Angles "
        "that Acrobot-v1 wraps are compared up to whole turns. Pendulum-v1 rounds the torque's part to "
        "float32, since its actions are float32; this rounding counts as error. CartPole-v1 falls within a "
        "second under random actions, so its update is also continued past that end, to 10 s.",
        "The error at a time is the largest over the entries of the state and over all times until then. "
        "Each entry is relative to its largest size in the episode, or to 1 in SI units if that is larger. "
        "No method that starts from float64 numbers can do better than about one rounding of the start, "
        "amplified by the system. This rounding floor is shown too: every entry of the start is moved by "
        "2^-53 of its size, and the motion is propagated exactly. If the system damps or does not amplify, "
        "roundings of later steps add to this floor.",
        "The exact flows of pendulum and linear motion have a truncation error below rounding. A step of "
        "the general series is divided until the truncation error of each part, as its certificate says, "
        f"is less than {TOLERANCE:g} of a velocity's size, and no further. If steps are long, or if "
        "friction changes within a narrow range of speeds, the error comes close to that limit, which is "
        "many roundings.",
        "The error of one step is the largest error of any step of the episode. Each step is repeated in "
        "exact arithmetic from the state recorded before it, and compared with the state recorded after "
        "it. lag_envs carries cosine and sine beside the angle. If an angle has grown to many turns, its "
        "rounding differs from that of the pair, and this difference counts as error too.",
    ]


def _column(mark: str) -> str:
    return "largest error of one step" if mark == "one step" else f"error up to {mark}"


def _largest(values: Sequence[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return max(there) if len(there) == len(values) and there else None


def _ratio(row: Row) -> float:
    return row["error"]["the end"] / row["amplified"]["the end"]


def _is_general(row: Row) -> bool:
    """Return whether an environment of lag_envs is stepped by the general series."""
    return form_of(TASKS[row["case"]]().scene) is None


def _share(row: Row) -> float:
    """Return an episode's error relative to its limit with the general series."""
    limit = max(ROUNDINGS * row["amplified"]["the end"], TOLERANCE * row["steps"])
    return row["error"]["the end"] / limit


def _span(values: Sequence[float]) -> str:
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"


def _cases_table(episodes: dict[str, list[Row]], failed: dict[str, str]) -> Table:
    def at(mark: str) -> Callable[[list[Row]], float | None]:
        return lambda group: _largest([r["error"][mark] for r in group])

    table = Table.of(
        "environment-errors",
        "Errors relative to the size of the state. Largest over the episodes unless stated otherwise; "
        "empty if an episode had ended before.",
        {
            "environment": lambda group: group[0]["case"],
            "integrator": lambda group: group[0]["integrator"],
            "dt [s]": lambda group: group[0]["dt"],
            "episodes": len,
            "length [s]": lambda group: _span([r["seconds"] for r in group]),
            **{_column(mark): at(mark) for mark in MARKS[:-1]},
            "whole episode, median": lambda group: median(r["error"]["the end"] for r in group),
            "whole episode, largest": at("the end"),
            "amplified rounding": lambda group: max(r["amplified"]["the end"] for r in group),
            "error over amplified rounding": lambda group: max(map(_ratio, group)),
            "problem": lambda group: "",
        },
        episodes.values(),
    )
    empty = [None] * (len(table.columns) - 2)
    return replace(table, rows=[*table.rows, *([name, *empty, problem] for name, problem in failed.items())])


def _entries_table(cases: dict[str, list[Row]]) -> Table:
    lines = []
    for case, group in cases.items():
        for i, entry in enumerate(group[0]["entries"]):
            errors = [_largest([r["entries"][i][mark] for r in group]) for mark in MARKS]
            size = max(r["entries"][i]["size"] for r in group)
            lines.append([case, entry["name"], entry["unit"], size, *errors])
    return Table(
        "environment-entries",
        "Errors of each entry of the state in its unit: the largest over the episodes. Size: the largest "
        "value that the entry reaches, at least 1.",
        ["environment", "entry", "unit", "size", *map(_column, MARKS)],
        lines,
    )


def _free_table(free: list[Row]) -> Table:
    lines = []
    for row in free:
        angle = next(e for e in row["entries"] if e["name"] == "theta")
        steps = [row["case"], row["integrator"], row["dt"], angle["one step"], angle["1 s"], angle["10 s"]]
        lines.append([*steps, row["amplified"]["10 s"], _ratio(row), 100.0 * row["gain"]])
    return Table(
        "environment-undriven",
        f"A pendulum without control, released at rest {RELEASED} rad from hanging: the error of its angle, "
        f"and how much its energy above rest, which should be constant, grows in {LONG:g} s. The lag_envs "
        "pendulum has the equation of motion of Pendulum-v1. A step of 0.05 s is 2.5 times as long as the "
        "step that its series is designed for, so the error is truncation within the 1e-12 rad/s allowed "
        "per step; at 0.02 s only rounding is left. CartPole-v1 is given no force.",
        [
            *("case", "integrator", "dt [s]", "angle, one step [rad]", "up to 1 s [rad]"),
            *("up to 10 s [rad]", "amplified rounding", "error over amplified rounding"),
            f"energy gained in {LONG:g} s [%]",
        ],
        lines,
    )


def _details(rows: list[Row]) -> Table:
    lines = [
        [r["case"], r["seed"], r["steps"], r["terminated"], e["name"], e["unit"], *(e[m] for m in MARKS)]
        for r in rows
        for e in r["entries"]
    ]
    columns = ["case", "seed", "steps", "terminated", "entry", "unit", *map(_column, MARKS)]
    return Table(
        "environment-episodes", "Errors of each episode, entry by entry, in its unit.", columns, lines
    )


def _summary(episodes: dict[str, list[Row]]) -> Table | None:
    table = Table.of(
        "environments",
        "Error against the exact motion under the same controls, relative to the size of the state: the "
        "largest over random episodes. One step: the largest over all their steps. Last column: the error "
        "divided by one rounding of the start, as amplified by the system.",
        {
            "environment": lambda group: group[0]["case"],
            "integrator": lambda group: group[0]["integrator"],
            "one step": lambda group: _largest([r["error"]["one step"] for r in group]),
            "whole episode": lambda group: max(r["error"]["the end"] for r in group),
            "length [s]": lambda group: _span([r["seconds"] for r in group]),
            "error / rounding floor": lambda group: max(map(_ratio, group)),
        },
        episodes.values(),
    )
    return table if table.rows else None


def _claims(rows: list[Row]) -> list[Claim]:
    made = [r for r in rows if r["own"] and r["seed"] is not None]
    peers = [r for r in rows if not r["own"] and r["seed"] is not None]
    apart = [r["disagreement"] for r in made if "disagreement" in r]
    free = [r for r in rows if r["seed"] is None]
    same = {r["own"]: r for r in free if "Pendulum-v1" in r["case"] and r["dt"] == 0.05}
    twins = [r for r in made if TASKS[r["case"]].peer]
    twin = max(twins, key=lambda r: r["error"]["the end"], default=None)
    least = min(peers, key=lambda r: r["error"]["the end"], default=None)
    flows, series = ([r for r in made if _is_general(r) is general] for general in (False, True))
    above = max(flows, key=_ratio, default=None)
    furthest = max(flows, key=lambda r: r["error"]["the end"], default=None)
    worst = max(series, key=_share, default=None)
    return [
        Claim(
            f"With exact flows every error stays below {ROUNDINGS:g} times one rounding of the start, as "
            "amplified by the system itself.",
            _ratio(above) <= ROUNDINGS if above else None,
            f"{_ratio(above):.2g} times in {above['case']}, of {len(flows)} episodes" if above else "",
        ),
        Claim(
            f"With the general series it stays below that, or below {TOLERANCE:g} of the state's size for "
            "each step so far.",
            _share(worst) <= 1.0 if worst else None,
            f"{worst['error']['the end']:.2g} after {worst['steps']} steps of {worst['case']}, where a "
            f"rounding becomes {worst['amplified']['the end']:.2g}; {len(series)} episodes"
            if worst
            else "",
        ),
        _of_steps(flows, LARGEST_STEP, "No step of an exact flow"),
        _of_steps(series, PROMISED, "No step of the general series"),
        Claim(
            f"With exact flows no episode is off by more than {LARGEST_ERROR:g} of the state's size.",
            furthest["error"]["the end"] <= LARGEST_ERROR if furthest else None,
            f"{furthest['error']['the end']:.2g} in {furthest['case']}" if furthest else "",
        ),
        Claim(
            f"Every episode of Gymnasium's environments is off by more than {APART:g} times the largest "
            "error of lag_envs with the same equations.",
            least["error"]["the end"] > APART * twin["error"]["the end"] if twin and least else None,
            f"{least['case']}: at least {least['error']['the end']:.2g}, "
            f"{least['error']['the end'] / twin['error']['the end']:.1g} times that of {twin['case']}"
            if twin and least
            else "",
        ),
        Claim(
            "On the undriven pendulum with the same equation and step, Pendulum-v1 is off by more than "
            f"{APART:g} times as much as lag_envs, after 10 s.",
            _angle(same[False]) > APART * _angle(same[True]) if len(same) == 2 else None,
            "; ".join(f"{r['case']}, dt {r['dt']:g} s: {_angle(r):.3g} rad" for r in free),
        ),
        Claim(
            "Two computations of the exact states with different digits agree to 1e-25.",
            max(apart) <= 1e-25 if apart else None,
            f"{max(apart):.1g} apart in {len(apart)} episodes" if apart else "",
        ),
    ]


def _of_steps(rows: list[Row], limit: float, subject: str) -> Claim:
    worst = max(rows, key=lambda r: r["error"]["one step"], default=None)
    return Claim(
        f"{subject} is off by more than {limit:g} of the state's size.",
        worst["error"]["one step"] <= limit if worst else None,
        f"{worst['error']['one step']:.2g} in {worst['case']}, of {sum(r['steps'] for r in rows):,} steps"
        if worst
        else "",
    )


def _angle(row: Row) -> float:
    """Return the largest error of an undriven pendulum's angle [rad]."""
    return next(e["the end"] for e in row["entries"] if e["name"] == "theta")


def _colour(row: Row) -> str:
    return BLUE if row["own"] else PEERS[row["case"].partition(",")[0]].colour


def _curve(row: Row) -> tuple[list[float], list[float], list[float]]:
    """Return times, errors and amplified roundings; exact zeros are drawn at the lower end of the picture."""
    times, errors, amplified = zip(*row["curve"], strict=True)
    return list(times), [max(e, 1e-19) for e in errors], list(amplified)


def _draw_all(episodes: dict[str, list[Row]]) -> Figure:
    figure = Figure(figsize=(8, 5.2), layout="constrained")
    axes = figure.add_subplot()
    named: set[str] = set()
    for row in sorted(itertools.chain(*episodes.values()), key=lambda r: r["own"]):
        name = "lag_envs, all environments" if row["own"] else row["case"].partition(",")[0]
        times, errors, amplified = _curve(row)
        label = None if name in named else name
        named.add(name)
        axes.plot(times, errors, color=_colour(row), lw=1.8 if row["own"] else 1.2, label=label)
        axes.plot(times, amplified, color=_colour(row), lw=0.7, ls=":")
    axes.plot([], [], color=GREY, lw=1, ls=":", label="one rounding of the start, amplified")
    axes.set(xscale="log", yscale="log", xlabel="time in the episode [s]", ylim=(1e-18, 30))
    axes.set_ylabel("error relative to the state's size")
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(0.0, 0.52), fontsize=9)
    return figure


def _draw_each(episodes: dict[str, list[Row]]) -> Figure:
    columns = 3
    lines = -(-len(episodes) // columns)
    figure = Figure(figsize=(8, 0.6 + 1.75 * lines), layout="constrained")
    grid = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[len(episodes) :]:
        axes.set_axis_off()
    for axes, (case, group) in zip(grid.flat, episodes.items(), strict=False):
        for row in group:
            times, errors, amplified = _curve(row)
            axes.plot(times, errors, color=_colour(row), lw=1.6)
            axes.plot(times, amplified, color=GREY, lw=1, ls=":")
        axes.set(xscale="log", yscale="log", ylim=(1e-18, 30))
        axes.set_title(case, fontsize=9)
        axes.grid(alpha=0.3)
        axes.tick_params(labelsize=8)
    figure.supxlabel("time in the episode [s]", fontsize=9)
    figure.supylabel("error relative to the state's size", fontsize=9)
    return figure
