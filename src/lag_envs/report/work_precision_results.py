"""Results from the points of `work_precision`: who is faster at which error, in tables, claims and sentences.

The fastest form and setting of each rival that reaches an error is compared with the fastest of the shipped
stepping; defeats are reported like wins. Sentences are made from the numbers, so they cannot go stale.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

from lag_envs.report.cases import VARIANTS
from lag_envs.report.content import Claim, Content, ReportFigure, Table
from lag_envs.report.diagrams import draw_variant
from lag_envs.report.points import (
    HORIZONS,
    LAG_ENVS,
    LIBRARIES,
    MODES,
    ROUNDING,
    TARGETS,
    WorkPrecisionPoint,
    gathered,
)
from lag_envs.report.runner import JobResult, Row

#: An error below this many roundings, or amplified roundings, counts as no error at all.
ROUNDINGS = 4
#: The errors in the table of docs/accuracy.md.
SHOWN = TARGETS[1:]
#: Error at which lag_envs is claimed to be the fastest: the promised accuracy of a step, and what the
#: system's amplification leaves of it over a long time.
CLAIMED = {"one step": 1e-12, "10 s": 1e-12, "1,000 s": 1e-9}

#: Required error of each form's finest setting, so that no form is fast because it is broken.
ACCURATE = 1e-9


def floors(rows: Sequence[Row]) -> dict[tuple, float]:
    """Return the amplified rounding by variant and horizon."""
    return {
        (r["variant"], r["horizon"]): max(r["amplified"], ROUNDING) for r in rows if r["kind"] == "rounding"
    }


class Duel(NamedTuple):
    """The fastest form of lag_envs and the fastest rival at an error, for a variant, horizon and mode."""

    variant: str
    horizon: str
    mode: str
    target: float
    own: WorkPrecisionPoint | None
    rival: WorkPrecisionPoint | None

    @property
    def ratio(self) -> float | None:
        """The rival's time over that of lag_envs; below 1 the rival wins."""
        return self.rival.ns / self.own.ns if self.own and self.rival else None

    @property
    def lost(self) -> bool:
        """Whether a rival is faster, or alone reaches the error."""
        return self.rival is not None and (self.ratio is None or self.ratio < 1.0)

    @property
    def where(self) -> str:
        """The variant and the mode."""
        return f"{self.variant} {MODES[self.mode]}"


def compared(points: Sequence[WorkPrecisionPoint], floor: dict[tuple, float]) -> list[Duel]:
    """Return all comparisons, with errors up to `ROUNDINGS` amplified roundings counting as none."""
    found = []
    for place in product(VARIANTS, HORIZONS, MODES):
        here = [p for p in points if (p.variant, p.horizon, p.mode) == place]
        least = ROUNDINGS * floor.get(place[:2], ROUNDING)
        for target in TARGETS if here else ():
            reached = [p for p in here if p.worst <= max(target, least)]
            own, rival = (
                min((p for p in reached if p.own is own), key=lambda p: p.ns, default=None)
                for own in (True, False)
            )
            found.append(Duel(*place, target, own, rival))
    return found


def content(rows: list[Row], problems: list[JobResult]) -> Content:
    """Return the section."""
    points = gathered(rows)
    floor = floors(rows)
    found = compared(points, floor)
    variants = [name for name in VARIANTS if any(p.variant == name for p in points)]
    return Content(
        title="Error against time",
        text=[*_text(rows), *horizon_findings(found)],
        tables=[_targets(found), _near(points), _orders(rows), _failed(rows, problems)],
        pictures=[
            ReportFigure(_file(name), _caption(name), partial(draw_variant, name, points, floor))
            for name in variants
        ],
        claims=claims(rows, points, found),
        summary=_summary(points, found),
        details=[_rivals(points), _left(rows), _all(points)],
    )


# --- sentences ---


def _text(rows: Sequence[Row]) -> list[str]:
    sizes = {r["members"] for r in rows if r["kind"] == "point" and "members" in r}
    members = f" (from {min(sizes)} to {max(sizes)} of them)" if len(sizes) > 1 else ""
    return [
        f"Errors are the largest over an ensemble of random states, controls and parameters{members}, and "
        "over the entries of the state. Each error is relative to the size of its entry, as "
        "docs/numerics.md defines accuracy; over 10 s and 1,000 s it is relative to the size at the end. "
        "The reference is exact to 30 digits: Lagrange's equations by SymPy, Taylor series in "
        "python-flint's balls, and for undamped pendulums that move far Jacobi's elliptic functions. The "
        "control is held over the whole time. Over 1,000 s there is no control, and pendulums have no "
        "damping.",
        "lag_envs is timed as shipped: each scene's own order and tolerance, control step by control step. "
        "Over 10 s and 1,000 s there are also steps of half to eight times that length, and a single step "
        "that `simulate` divides ('lag_envs, one call'). The time includes testing whether a step is "
        "certified.",
        "Every rival gets the scene's own equation in its fastest form, and errors are those of the calls "
        "that are timed. The usual integrators are compiled by the same compiler at the same vector width "
        "as lag_envs, with precomputed coefficients. 'Carried' methods have cosine and sine as unknowns, "
        "or rotate them by short polynomials, and call no function. If a control is held for long, these "
        "integrators also take one step for several control steps. heyoka runs with fast_math: single "
        "steps are calls of its own machine code from a compiled loop, longer times are one call of "
        "propagate_until, and a batch is stepped in blocks of twice the recommended width. SciPy's "
        "compiled dopri5, dop853 and lsoda have a compiled right-hand side, and a batch is one system; "
        "Radau is that of solve_ivp. diffrax is compiled as a whole, as a loop over states or a map. In "
        "torchdiffeq a batch is one tensor. MuJoCo runs in its compiled rollouts without contacts and "
        "constraints. SciPy's Radau and MuJoCo have no batch, so they take one state after the other. "
        "Anything that would take more than a few seconds is not run.",
        "Times are those of one control step. Each method is timed in turn with lag_envs; medians are given. "
        "The times of different jobs are made comparable by the time of lag_envs in each "
        "job. Over 10 s or 1,000 s, slow methods are timed over only a part of that time, also in one "
        "call.",
    ]


def horizon_findings(found: Sequence[Duel]) -> list[str]:
    """Return, for every horizon, a paragraph on who is faster at which error, and by how much."""
    paragraphs = []
    for horizon in HORIZONS:
        here = [d for d in found if d.horizon == horizon]
        sentences = [f"To {t:.0e}: {_finding([d for d in here if d.target == t])}." for t in TARGETS if here]
        if sentences:
            paragraphs.append(f"{horizon.capitalize()}. " + " ".join(sentences))
    return paragraphs


def _finding(found: Sequence[Duel]) -> str:
    """Return who is faster at one error, as a clause that counts every comparison."""
    settled = sorted((d for d in found if d.ratio is not None), key=lambda d: d.ratio or 0.0)
    lost = [d for d in settled if d.lost]
    won = [d for d in settled if not d.lost]
    parts = []
    if lost:
        named = [f"{d.ratio:.2g} ({d.where}: {d.rival.label})" for d in (lost[0], lost[-1]) if d.rival]
        parts.append(
            f"a rival is faster in {len(lost)} of {len(found)} comparisons and takes "
            f"{' to '.join(dict.fromkeys(named))} of the time of lag_envs"
        )
    if won:
        ratios = [f"{d.ratio:.2g}" for d in (won[0], won[-1])]
        parts.append(
            f"lag_envs is faster in {len(won)} of {len(found)}, where the fastest rival takes "
            f"{' to '.join(dict.fromkeys(ratios))} times as long"
        )
    for words, some in (
        ("no other method reaches the error", [d for d in found if d.own and not d.rival]),
        ("lag_envs does not reach the error and a rival does", [d for d in found if d.rival and not d.own]),
        ("no method reaches the error", [d for d in found if not d.rival and not d.own]),
    ):
        if some:
            parts.append(f"{words} in {len(some)} ({', '.join(d.where for d in some)})")
    return "; ".join(parts)


# --- tables ---


def _targets(found: Sequence[Duel]) -> Table:
    return Table(
        "work_precision_targets",
        "The fastest form of lag_envs, and of all other methods, that reaches an error; below 1 the other "
        "method is faster. Empty cell: not reached.",
        [
            "scene", "horizon", "mode", "error", "lag_envs", "lag_envs: error", "lag_envs: ns",
            "fastest other", "other: error", "other: ns", "other / lag_envs",
        ],
        [
            [
                d.variant, d.horizon, MODES[d.mode], d.target,
                d.own and d.own.label, d.own and d.own.worst, d.own and d.own.ns,
                d.rival and d.rival.label, d.rival and d.rival.worst, d.rival and d.rival.ns, d.ratio,
            ]
            for d in found
        ],
    )  # fmt: skip


#: Rivals slower than this many times our time appear only in the CSV tables.
NEAR = 10.0


def _near(points: Sequence[WorkPrecisionPoint]) -> Table:
    table = _rivals(points)
    rows = [row for row in table.rows if min(x for x in row[3:-1] if x is not None) <= NEAR]
    return Table(
        "work_precision_near", f"{table.caption} Those within {NEAR:g} times our time.", table.columns, rows
    )


def _rivals(points: Sequence[WorkPrecisionPoint]) -> Table:
    """Return every rival's shortest time to each error, for one step."""
    rows = []
    here = [p for p in points if p.horizon == "one step" and not p.own]
    for variant, mode in product(VARIANTS, MODES):
        group = [p for p in here if (p.variant, p.mode) == (variant, mode)]
        shipped = _default(points, variant, mode)
        for name in dict.fromkeys(p.name for p in group) if shipped else ():
            some = [p for p in group if p.name == name]
            best = [min((p.ns for p in some if p.worst <= t), default=None) for t in TARGETS]
            if shipped and any(best):
                ratios = [ns and ns / shipped.ns for ns in best]
                rows.append([variant, MODES[mode], name, *ratios, min(p.worst for p in some)])
    return Table(
        "work_precision_rivals",
        "Each rival's shortest time to an error in one control step, as a multiple of the time of lag_envs, "
        "and its smallest error. Below 1 the rival is faster. Empty cell: not reached.",
        ["scene", "mode", "rival", *(f"to {target:.0e}" for target in TARGETS), "smallest error"],
        rows,
    )


def _default(points: Sequence[WorkPrecisionPoint], variant: str, mode: str) -> WorkPrecisionPoint | None:
    key = variant, "one step", mode, LAG_ENVS
    return next((p for p in points if (p.variant, p.horizon, p.mode, p.method) == key), None)


def _summary(points: Sequence[WorkPrecisionPoint], found: Sequence[Duel]) -> Table:
    rows = []
    steps = [d for d in found if d.horizon == "one step"]
    for name, mode in product(VARIANTS, MODES):
        if shipped := _default(points, name, mode):
            here = {d.target: d for d in steps if (d.variant, d.mode) == (name, mode)}
            numbers = f"{shipped.worst:.0e}", round(shipped.ns, 1)
            rows.append([name, MODES[mode], *numbers, *(_rival(here[t]) for t in SHOWN)])
    sentences = [f"To {t:.0e}: {_finding([d for d in steps if d.target == t])}." for t in SHOWN if steps]
    return Table(
        "work_precision",
        "One control step of each scene, alone and in a batch of 1,024: largest error and time of lag_envs "
        "as shipped, and the fastest of its rivals, each in its fastest form, that reaches an error, with "
        "its time as a multiple of that of lag_envs; below 1 the rival is faster. " + " ".join(sentences),
        ["scene", "mode", "error", "ns", *(f"to {target:.0e}" for target in SHOWN)],
        rows,
    )


def _rival(comparison: Duel) -> str:
    rival, ratio = comparison.rival, comparison.ratio
    return f"{rival.label}: {ratio:.2g} ×" if rival and ratio else "none"


def _orders(rows: Sequence[Row]) -> Table:
    return Table.of(
        "work_precision_orders",
        "Order of convergence, from the slope of the error of one step over its length, less one: the "
        "median over 24 problems on PivotedBar, with the shortest pair of steps h and 2h whose errors lie "
        "well above rounding.",
        {
            "method": "method",
            "order": "order",
            "measured": "slope",
            "difference": lambda r: None if r["slope"] is None else r["slope"] - r["order"],
        },
        [r for r in rows if r["kind"] == "order"],
    )


def _failed(rows: Sequence[Row], problems: Sequence[JobResult]) -> Table:
    found = [[result.name, "", "", result.problem] for result in problems]
    found += [
        [row["variant"], f"{row['horizon']}, {MODES[row['mode']]}", _setting(row), row["problem"]]
        for row in rows
        if row.get("problem") and not row["problem"].startswith("not run")
    ]
    columns = ["scene or job", "where", "method", "problem"]
    return Table("work_precision_problems", "What failed.", columns, found)


def _left(rows: Sequence[Row]) -> Table:
    found = []
    for row in rows:
        lost = row.get("diverged")
        problem = row.get("problem") or (f"diverged, {lost} of {row['members']}" if lost else None)
        if problem:
            found.append([row["variant"], row["horizon"], MODES[row["mode"]], _setting(row), problem])
    return Table(
        "work_precision_left",
        "Not run, or diverged: members whose end is not a number, or is farther off than their own size. "
        "They are drawn at the upper edge. Finer settings of methods that would take too long are not run "
        "either.",
        ["scene", "horizon", "mode", "method", "problem"],
        found,
    )


def _setting(row: Row) -> str:
    return f"{LIBRARIES.get(row['family'], '')} {row['method']}, {row['setting']:g}".strip()


def _all(points: Sequence[WorkPrecisionPoint]) -> Table:
    return Table(
        "work_precision_points",
        "All points: largest and median error, members lost, time of a control step.",
        [
            "scene", "horizon", "mode", "family", "method", "setting", "error", "median", "members",
            "diverged", "ns",
        ],
        [[*p[:6], p.error, p.median, len(p.errors), p.diverged, p.ns] for p in points],
    )  # fmt: skip


# --- claims ---


def claims(rows: Sequence[Row], points: Sequence[WorkPrecisionPoint], found: Sequence[Duel]) -> list[Claim]:
    """Return the claims and whether they hold; docs/accuracy.md lists the claims that do not."""
    steps = [p for p in points if p.own and p.method == LAG_ENVS and p.horizon == "one step"]
    largest = max((p.worst for p in steps), default=math.nan)
    finest = _finest(points)
    off = [f"{name} on {where}: {error:.1e}" for (name, where), error in finest.items() if error > ACCURATE]
    slopes = [
        (r["method"], abs(r["slope"] - r["order"])) for r in rows if r["kind"] == "order" and r["slope"]
    ]
    method, worst = max(slopes, key=lambda x: x[1], default=("", 0.0))
    same = _same_bits(rows)
    return [
        *(_fastest(found, horizon, target) for horizon, target in CLAIMED.items()),
        _claim(
            "The error of one control step stays below 1e-15 on every scene",
            steps,
            largest < 1e-15,
            f"largest {largest:.1e}, scenes measured: {len({p.variant for p in steps})}",
        ),
        _claim(
            "No form is fast because it is broken: at its finest setting every library, and every "
            f"integrator of order 4 and more, errs by at most {ACCURATE:.0e} in one step",
            finest,
            not off,
            ", ".join(off) or f"{len(finest)} forms; largest {max(finest.values(), default=0.0):.1e}",
        ),
        _claim(
            "Every method converges with its order, within 0.2",
            slopes,
            worst <= 0.2,
            f"largest difference {worst:.2f}, {method}",
        ),
        _claim(
            "Batches that are timed end bit for bit where single trajectories do, for lag_envs and others",
            same,
            all(same),
            f"{sum(same)} of {len(same)}",
        ),
    ]


def _claim(text: str, measured: Any, holds: bool, evidence: str) -> Claim:
    return Claim(text, holds, evidence) if measured else Claim(text, None, "not measured")


def _fastest(found: Sequence[Duel], horizon: str, target: float) -> Claim:
    here = [d for d in found if d.horizon == horizon and d.target == target and (d.own or d.rival)]
    faster = [
        f"{d.where}: {d.rival.label}, {f'{d.ratio:.2g} ×' if d.ratio else 'lag_envs not at all'}"
        for d in here
        if d.lost and d.rival
    ]
    ratios = [d.ratio for d in here if d.ratio is not None]
    evidence = f"{len(here) - len(faster)} of {len(here)}; "
    if faster:
        evidence += f"faster: {'; '.join(faster)}"
    elif ratios:
        evidence += f"the fastest rivals take {min(ratios):.2g} to {max(ratios):.2g} × our time"
    else:
        evidence += "no other method reaches the error"
    return _claim(
        f"{horizon.capitalize()}: nobody reaches an error of {target:.0e} in less time than lag_envs as "
        "shipped, alone or in a batch",
        here,
        not faster,
        evidence,
    )


#: Methods of lower order, which are not required to be accurate.
LOW = ("explicit Euler", "semi-implicit Euler", "Verlet", "implicit midpoint", "Euler", "implicitfast")


def _finest(points: Sequence[WorkPrecisionPoint]) -> dict[tuple[str, str], float]:
    """Return the smallest error of each form of each rival in one step, by method and place."""
    found: dict[tuple[str, str], float] = {}
    for p in points:
        low = p.method.partition(",")[0] in LOW
        if p.horizon == "one step" and not p.own and not low:
            key = p.name, f"{p.variant} {MODES[p.mode]}"
            found[key] = min(found.get(key, math.inf), p.worst)
    return found


def _same_bits(rows: Sequence[Row]) -> list[bool]:
    seen: dict[tuple, dict[str, str]] = {}
    for r in rows:
        if r["kind"] == "point" and r["family"] in ("lag_envs", "compiled") and "digest" in r:
            key = r["variant"], r["horizon"], r["method"], r["setting"]
            seen.setdefault(key, {})[r["mode"]] = r["digest"]
    return [len(set(digests.values())) == 1 for digests in seen.values() if len(digests) == len(MODES)]


def _file(variant: str) -> str:
    return "work_precision_" + variant.lower().replace(", ", "_")


def _caption(variant: str) -> str:
    return (
        f"{variant}: largest error against the time of a control step. Lower left is better. Columns: one "
        "control step, 10 s, 1,000 s; rows: alone, and in a batch (1,024 states; 128 over 10 s and 1,000 "
        "s). The faster form of each method is drawn. Thin bars reach down to the median error. Dotted: "
        "one rounding of the start, amplified by the system itself. Reference: 30 digits, by closed forms "
        "if there are any, otherwise by Taylor series."
    )
