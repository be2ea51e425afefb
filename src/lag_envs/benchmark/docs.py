"""A report in this project's documentation: ``docs/speed.json``, docs/speed.md and README's summary."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lag_envs.benchmark import divisions
from lag_envs.benchmark.chain_costs import Costs, cost_table, growth, write_figure
from lag_envs.benchmark.results import times_of
from lag_envs.benchmark.rounds import CORE
from lag_envs.benchmark.targets import SERIES_TARGETS, TARGETS, SpeedTarget, has_own_flow, reached_targets
from lag_envs.generated import replaced
from lag_envs.store import readable_json, write_file
from lag_envs.tables import markdown_table, rate_text

#: The picture of chains' costs, in docs.
CHAINS = Path("images", "chains.svg")


def take_over(report: dict[str, Any], checkout: Path) -> None:
    """Write a report into a checkout: ``docs/speed.json``, and its texts in docs/speed.md and README."""
    write_file(checkout / "docs" / "speed.json", readable_json(report))
    for path, text in texts(report, checkout).items():
        write_file(path, text)
    if costs := _with_series(report):
        write_figure(costs, checkout / "docs" / CHAINS)


def other_processor(report: dict[str, Any]) -> str:
    """Return docs/speed.md's sentences on another processor, about the largest batches."""
    target = TARGETS[-1]
    ratios = reached_targets(report["rows"], target)
    shares = {row["id"]: 100 * row["share"][1] for row in report["arithmetic"]}
    below = sorted(shares[id] for id, ratio in ratios.items() if ratio < target.ratio)
    peak = next(row["steps_per_second"][1] for row in report["rows"] if row["library"] == CORE)
    found = (
        f"On another {report['machine']['processor']}, with a peak of {rate_text(peak)} multiply-adds a "
        f"second, {len(ratios)} environments with a specialised integrator, {target.num_envs:,} at once, "
        f"reach {min(ratios.values()):.2g} to {max(ratios.values()):.2g} times CartPole's speed "
        f"(`docs/speed-other.json`, {report['date']})."
    )
    if below:
        found += (
            f" {len(below)} of them are below the target of {target.ratio:g}, at {below[0]:.0f} to "
            f"{below[-1]:.0f} % of the peak."
        )
    return " ".join([found, *_told(report, "Scenes defined by energies alone: ")])


def texts(report: dict[str, Any], checkout: Path) -> dict[Path, str]:
    """Return the texts that a checkout's files should have for a report."""
    page, readme = checkout / "docs" / "speed.md", checkout / "README.md"
    short = claim(report, " ([speed](docs/speed.md))")
    text = replaced(page.read_text(encoding="utf-8"), "bench", speed_markdown(report))
    return {
        page: replaced(text, "fast", claim(report)),
        readme: replaced(readme.read_text(encoding="utf-8"), "fast", short),
    }


def speed_markdown(report: dict[str, Any]) -> str:
    """Return the table of docs/speed.md: every environment at the sizes of `TARGETS`; misses are marked.

    Parameters
    ----------
    report : dict
        The result of `bench` for these sizes, including CartPole-v1.
    """
    rows = {(row["library"], row["id"], row["kind"], row["num_envs"]): row for row in report["rows"]}
    rival = ("gymnasium", "CartPole-v1")

    def cell(library: str, id: str, target: SpeedTarget) -> str:
        row = rows[library, id, target.kind, target.num_envs]
        if "steps_per_second" not in row:
            return row["problem"] or "not measured"
        time = 1e9 / row["steps_per_second"][1]
        text = f"{time:,.0f} ns" if time >= 99.5 else f"{time:.3g} ns"
        if (library, id) == rival:
            return text
        ratio = row["ratio"][1]
        if target.meant_for(row) and ratio < target.ratio:
            return f"{text}, **{ratio:.2f}×, missed**"
        return f"{text}, {ratio:.1f}×" if ratio >= 1.0 else f"{text}, {ratio:.2f}×"

    sizes = ["1 (`gym.make`)" if t.kind == "made" else f"{t.num_envs:,} at once" for t in TARGETS]
    ids = dict.fromkeys(row["id"] for row in report["rows"] if row["library"] == "lag_envs")
    lines = [
        *([id, *(cell("lag_envs", id, t) for t in TARGETS)] for id in ids),
        ["CartPole-v1", *(cell(*rival, t) for t in TARGETS)],
        ["*target*", *(f"*{t.ratio:g}×*" for t in TARGETS)],
    ]
    machine, settings = report["machine"], report["settings"]
    peaks = [row["steps_per_second"][1] for row in report["rows"] if row["library"] == CORE and row["rates"]]
    peak = f", with a peak of {rate_text(peaks[0])} multiply-adds a second" if peaks else ""
    parts = [
        "Time of a step, also as a multiple of the time of Gymnasium's `CartPole-v1` for equally many "
        f"environments: medians of {settings['rounds']} rounds, {settings['clock']} time on one core of "
        f"{machine['processor']}{peak} (`lag-envs bench`, Gymnasium {report['versions']['gymnasium']}, "
        f"{report['date']}).",
        markdown_table(["id", *sizes], lines),
    ]
    parts += _told(report, "Scenes defined by energies alone, compared with the same `CartPole-v1`: ")
    if costs := _with_series(report):
        head, *body = cost_table(costs)
        parts += [
            f"Chains of bars, pushed at random: {growth(costs)}. Longer chains whip faster, so the "
            "certificate divides their steps into more series.",
            markdown_table(head, body),
            f"![Time of a step and of one series by the number of bars]({CHAINS.as_posix()})",
        ]
    if found := report.get("divisions"):
        parts.append(
            "The number of series into which the certificate divides steps under random actions, and the "
            "time of one, many at once. Other environments never needed more than one; those with "
            "imperfections were left out."
        )
        parts.append(divisions.divisions_markdown(found, times_of(report)))
    if cold := report["cold_start"]:
        starts = " and ".join(f"{part['median']:.2f} s with its cache {name}" for name, part in cold.items())
        parts.append(f"A whole process (import, make, reset, first step) took {starts}.")
    return "\n\n".join(parts)


def _with_series(report: dict[str, Any]) -> Costs | None:
    """Return the costs of chains, if their series were counted."""
    costs: Costs | None = report.get("chains")
    return costs if costs and "series" in costs else None


def _told(report: dict[str, Any], start: str) -> list[str]:
    """Return a sentence on the general series; none if it was not measured."""
    told = list(filter(None, (_of_series(report["rows"], target) for target in SERIES_TARGETS)))
    return [f"{start}{'; '.join(told)}."] if told else []


def _of_series(rows: list[dict[str, Any]], target: SpeedTarget) -> str:
    """Return the measurements of the general series that have a target."""
    for row in rows:
        if target.meant_for(row) and "ratio" in row:
            time, ratio = 1e9 / row["steps_per_second"][1], row["ratio"][1]
            aim = f"target {target.ratio:g}×" + (", missed" if ratio < target.ratio else "")
            return f"`{target.id}`, {target.num_envs:,} at once, {time:,.0f} ns, {ratio:.2f}× ({aim})"
    return ""


def claim(report: dict[str, Any], where: str = "") -> str:
    """Return README's summary of speed: the ranges of the table, and how many targets are missed.

    Parameters
    ----------
    report : dict
        The result of `bench`.
    where : str, optional
        A link to the targets.
    """
    own_rows = [row for row in report["rows"] if row["library"] == "lag_envs" and "ratio" in row]
    kinds = {"a specialised integrator": True, "the general series, or imperfections": False}
    lines = [
        [name, *(_range(some, target) for target in TARGETS)]
        for name, own in kinds.items()
        if (some := [row for row in own_rows if has_own_flow(row["id"]) is own])
    ]
    places = ["alone", *(f"{target.num_envs:,} at once" for target in TARGETS[1:])]
    missed = [
        ratio < target.ratio
        for target in (*TARGETS, *SERIES_TARGETS)
        for ratio in reached_targets(report["rows"], target).values()
    ]
    aims = f"{sum(missed)} {'is' if sum(missed) == 1 else 'are'} missed" if any(missed) else "all are met"
    return (
        "Steps per second, as multiples of those of Gymnasium's `CartPole-v1`:\n\n"
        + markdown_table(["environments with", *places], lines)
        + f"\n\nWe set {len(missed)} speed targets{where}; {aims}."
    )


def _range(rows: list[dict[str, Any]], target: SpeedTarget) -> str:
    """Return the smallest and the largest ratio of rows of a target's size."""
    size = target.kind, target.num_envs
    ratios = sorted(row["ratio"][1] for row in rows if (row["kind"], row["num_envs"]) == size)
    return f"{ratios[0]:.2g} to {ratios[-1]:.2g}" if ratios else ""
