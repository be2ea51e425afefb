"""The page docs/agents.md, and README's table of agents, from the summary of the agents' results."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from agents.analysis import LEVELS, Data
from agents.learners import learner_label
from lag_envs.benchmark.results import quartiles
from lag_envs.evaluation.conditions import NOMINAL, OFTEN
from lag_envs.evaluation.statistics import LEVEL, RESAMPLES
from lag_envs.scores import known_returns
from lag_envs.tables import markdown_table, mean_with_error, rate_text
from lag_envs.tasks import TASKS
from lag_envs.tasks.measured import measured_entry

IMAGES = "images"
ADAPTER = Path(__file__).with_name("results") / "adapter.json"
OPTIMA = Path(__file__).with_name("results") / "optimum"
BEHAVIOUR = Path(__file__).with_name("results") / "behaviour.json"
REAL_TIME = Path(__file__).with_name("results") / "real_time.json"
DOCS = Path(__file__).parents[1] / "docs"
plus_minus = partial(mean_with_error, most=4, exact=2)

# --- the page -----------------------------------------------------------------------------------------------


def agents_page(data: Data) -> str:
    """Return docs/agents.md, from what ``agents/results/summary.json`` holds."""
    envs = data["envs"]
    parts = [
        "# Agents: what they reach",
        "<!-- Made by `python -m agents.results` from agents/results/summary.json. Do not edit by hand. -->",
        "This page shows for each environment how well every agent does, what it loses when it acts more"
        " often or when a parameter, the noise or the delay changes, what its training took, and what is"
        " known about the optimum. At the end there are a figure of all environments, a comparison of the"
        " learners, and a description of how everything was measured.",
        _reading(),
    ]
    for env_id, env in envs.items():
        note = TASKS[env_id].note.strip() if env_id in TASKS else ""
        parts += [f"## {env_id}", *([note] if note else [])]
        parts += [_range(env_id, env), *_optimum(env_id)]
        parts += [_env_table(env, data["episodes"]), *_times(env), *_behaviour(env_id)]
        parts += _real_time(env_id)
        if env.get("problems"):
            parts.append("Left out:\n\n" + "\n".join(f"- {problem}" for problem in env["problems"]))
        parts.append(
            _image(f"agents-robustness-{env_id}.png", f"{env_id}: every agent under every condition")
        )
    parts += [
        "## All environments",
        "Each agent's result (filled), and its result when acting ten times as often (open):",
    ]
    parts.append(_image("agents-scores.png", "Results of all agents with intervals"))
    if data["learners"]:
        parts += ["### Learners", _learners_table(data["learners"], envs)]
        parts.append("Results of learners' policies during training, over steps and over seconds:")
        parts.append(_image("agents-steps.png", "Learning curves over steps"))
        parts.append(_image("agents-seconds.png", "Learning curves over seconds"))
        parts.append(
            "How likely a training run of one learner is to end with a better policy than another agent's:"
        )
        if any(env["improvement"] for env in envs.values()):
            parts.append(_image("agents-improvement.png", "Probability of improvement"))
            parts.append(_improvement_table(envs))
    parts += ["## The adapter", adapter_rates()] if ADAPTER.exists() else []
    parts += ["## How it was measured", _method(data), "### Noise", _noise_table(envs)]
    parts += ["### Machine and versions", _about(data)]
    return "\n\n".join(parts) + "\n"


def summary_table(data: Data) -> str:
    """Return the table of docs/training.md: each environment's scale and its best agent of each kind."""
    rows = []
    for env_id, env in data["envs"].items():
        best: dict[str, str] = {}
        for name, agent in env["agents"].items():  # the best first
            text = f"{labelled(name, agent)}: {with_interval(agent['conditions'][NOMINAL])}"
            best.setdefault(agent["kind"], text)
        rows.append(
            [
                f"`{env_id}`",
                *(f"{value:g}" for value in env["known"] or ("", "")),
                *(best.get(kind, "") for kind in ("classical", "learned", "optimal")),
            ]
        )
    head = ["environment", "score 0", "score 1"]
    head += [f"best {kind} agent: score" for kind in ("classical", "learned")] + ["optimal policy: score"]
    return markdown_table(head, rows)


def _reading() -> str:
    return (
        "A score is (return - random) / (best known - random): 0 for random actions, 1 for the best known"
        " policy, which need not be optimal. Without a scale, the tables show the return itself. For"
        " learners, the score is the interquartile mean over training seeds, in brackets its"
        f" {100 * LEVEL:g} % interval by a stratified bootstrap, and the return is the mean ± standard error"
        " over seeds (a single run is treated like the other agents). A learner's name is followed by its"
        " seeds and steps, in figures as seeds × thousands of steps. One seed says nothing about the next,"
        " and a learner with fewer steps cannot be compared with one with more. Other agents have no"
        " training seeds, so only the episodes vary: their scores have an interval of 1.96 standard errors"
        " to either side of the mean, and their returns the standard error over episodes. *Ten times as"
        " often* is the same policy acting in steps of a tenth, which reveals policies that exploit the"
        " discretisation. *Worst* is the lowest result under changed parameters, noise and delay. *Training*"
        " is the processor time of a run, averaged over its seeds; the leaderboard has the wall time, which"
        " is longer if the machine also did other work. Fast PPO is `agents/ppo.py`, which commands call"
        " `fast_ppo`."
    )


def _range(env_id: str, env: Data) -> str:
    if env["known"] is None:
        return "Scores have no scale yet; the numbers are mean returns."
    random, best = env["known"]
    text = f"Score 0 is a mean return of {random:g}, score 1 a mean return of {best:g}."
    found, known = measured_entry(env_id).get("measured"), known_returns(env_id)
    if not found or not known or known.policy not in found:
        return text
    policy = known.policy
    told = [
        f"{what} {plus_minus(row['mean'], row['error'])} in {row['episodes']:,} episodes"
        for what, row in (
            ("random actions", found["random"]),
            (f"{policy}, the best known policy,", found[policy]),
        )
    ]
    return f"{text} Measured (`python -m agents.scale`): {'; '.join(told)}."


def _env_table(env: Data, episodes: int) -> str:
    what = "score" if env["known"] else "return"
    head = ["agent", "mean return", f"{what} ({100 * LEVEL:g} %)", "ten times as often", "worst", "training"]
    rows = []
    for name, agent in env["agents"].items():
        conditions = agent["conditions"]
        nominal, often = conditions[NOMINAL], conditions.get(OFTEN)
        others = {c: v["value"] for c, v in conditions.items() if c not in (NOMINAL, OFTEN)}
        worst = min(others, key=others.__getitem__, default=None)
        fewer = nominal["episodes"] != episodes
        rows.append(
            [
                labelled(name, agent) + (f" ({nominal['episodes']:,} episodes)" if fewer else ""),
                plus_minus(nominal["return"], nominal["return_error"]),
                with_interval(nominal),
                "" if often is None else with_interval(often),
                "" if worst is None else f"{meaningful_digits(others[worst])}: {worst}",
                f"{agent['seconds']:,.0f} s" if agent["kind"] == "learned" else "",
            ]
        )
    return markdown_table(head, rows)


def _times(env: Data) -> list[str]:
    """Return a table of when learners first reached the levels in a test."""
    rows = []
    for name, agent in env["agents"].items():
        if "reached" not in agent:
            continue
        row = [labelled(name, agent)]
        for found in (agent["reached"][str(level)] for level in LEVELS):
            count = f"{found['seeds']} of {len(agent['seeds'])}"
            median = found["steps"] is not None
            when = f": {found['steps']:,.0f} steps, {found['seconds']:.3g} s" if median else ""
            row.append(count + when)
        rows.append(row)
    if not rows:
        return []
    text = "How many seeds reached a score in a test, and the median over all seeds of the first such test:"
    return [text, markdown_table(["learner", *(f"{level:g}" for level in LEVELS)], rows)]


def labelled(name: str, agent: Data) -> str:
    """Return an agent's name; a learner's name is followed by its seeds and steps.

    Examples
    --------
    >>> labelled("sac", {"kind": "learned", "seeds": [0], "steps": 40_000.0})
    'SAC, 1 seed of 40,000 steps'
    """
    if agent["kind"] != "learned":
        return name
    seeds = len(agent["seeds"])
    return f"{learner_label(name)}, {seeds} seed{'s' * (seeds > 1)} of {agent['steps']:,.0f} steps"


def brief(name: str, agent: Data) -> str:
    """Return an agent's name for figures, followed by a learner's seeds and thousands of steps.

    Examples
    --------
    >>> brief("sac", {"kind": "learned", "seeds": [0], "steps": 40_000.0})
    'SAC 1 × 40k'
    """
    if agent["kind"] != "learned":
        return name
    return f"{learner_label(name)} {len(agent['seeds'])} × {agent['steps'] / 1000.0:.0f}k"


def stored(file: Path) -> Data:
    """Return what a command has measured; empty if it has not been run."""
    return json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}


def _behaviour(env_id: str) -> list[str]:
    """Return the measurements of `python -m agents.behaviour`."""
    found = stored(BEHAVIOUR)
    agents = found.get("envs", {}).get(env_id, {})
    if not any(agents.values()):
        return []

    def cell(values: Sequence[float | None]) -> str:
        there = [value for value in values if value is not None]
        ends = (
            f"{float(f'{value:.3g}'):,g}" if value >= 1e-3 or value == 0.0 else "< 0.001"
            for value in ((min(there), max(there)) if there else ())
        )
        return " to ".join(dict.fromkeys(ends)) or "never"

    head = ["how they act", *next(iter(agents.values()))]
    rows = []
    for name, by in agents.items():
        seeds = len(next(iter(by.values())))
        label = learner_label(name) + (f", {seeds} seeds" if seeds > 1 else "")
        rows.append([label, *map(cell, by.values())])
    text = (
        f"How agents act in the same {found['episodes']:,} episodes (`python -m agents.behaviour`): means,"
        " unless stated otherwise; for learners, the range over their seeds."
    )
    if any(name.startswith("lost") for name in head):
        text += " *Lost* is the sum of 1 minus the reward over the steps."
    return [text, markdown_table(head, rows)]


def _real_time(env_id: str) -> list[str]:
    """Return the measurements of `python -m agents.real_time`."""
    found, told = stored(REAL_TIME), []
    for name, row in found.get("envs", {}).get(env_id, {}).items():
        ms = {what: f"{1e3 * row[what]:.3g} ms" for what in ("interval", "median", "p99", "longest")}
        late = f"{100 * row['late']:.2g} %" if row["late"] else "none"
        text = (
            f"In {found['clocked']} episodes by the clock, a call of {name} took {ms['median']} (median),"
            f" {ms['p99']} (99 %) and {ms['longest']} (longest); {late} exceeded the interval of"
            f" {ms['interval']}."
        )
        if row["allowed"] is not None:
            text += (
                f" In real time its plans are made {1e3 * row['allowed']:g} ms ahead, in a separate"
                f" process. That costs {plus_minus(*row['loss'])} of the return, measured in"
                f" {found['episodes']} other episodes, and leaves {plus_minus(*row['return'])}."
            )
        told.append(text)
    return ["**In real time** (`python -m agents.real_time`). " + " ".join(told)] if told else []


def _learners_table(learners: Data, envs: Mapping[str, Data]) -> str:
    rows = []
    for name, found in learners.items():
        agents = [envs[env_id]["agents"][name] for env_id in found["envs"]]
        rows.append(
            [
                learner_label(name),
                _pooled(found),
                f"{len(found['envs'])}: {', '.join(found['envs'])}",
                _span(len(agent["seeds"]) for agent in agents),
                _span(agent["steps"] for agent in agents),
            ]
        )
    text = (
        "Over all environments with a score, each of them resampled separately. **This is not a comparison of"
        " algorithms**: compare only results with the same environments, seeds and steps."
    )
    head = ["learner", f"score ({100 * LEVEL:g} %)", "environments", "seeds of each", "steps of a seed"]
    return text + "\n\n" + markdown_table(head, rows)


def _span(values: Iterable[float]) -> str:
    ends = sorted(values)
    return " to ".join(dict.fromkeys(f"{value:,.0f}" for value in (ends[0], ends[-1])))


def _improvement_table(envs: Mapping[str, Data]) -> str:
    rows = [
        [
            env_id,
            labelled(one, env["agents"][one]),
            labelled(other, env["agents"][other]),
            _pooled(found),
        ]
        for env_id, env in envs.items()
        for one, others in env["improvement"].items()
        for other, found in others.items()
        if 0.0 < found["value"] < 1.0
        and (found["value"] >= 0.5 or env["agents"][other]["kind"] != "learned")
        and (found["value"] != 0.5 or one < other)
    ]
    if not rows:
        return "In every pair, all runs of one agent are better than all runs of the other."
    text = (
        f"Probabilities other than 0 and 1, with {100 * LEVEL:g} % intervals. Of two learners, the one"
        " that is more likely to be better comes first."
    )
    return text + "\n\n" + markdown_table(["environment", "learner", "better than", "probability"], rows)


def _method(data: Data) -> str:
    return "\n".join(
        [
            f"- Episodes: {data['episodes']:,} under each condition, unless stated otherwise. Their"
            f" seeds start at {data['first_seed']:,}, are never used in training and tuning, and are the same"
            " for all agents. Agents act deterministically.",
            "- *Settings*: those of fast PPO were chosen by trainings with seeds 0 and 1, which are"
            " among the reported seeds. Its scores may be slightly optimistic, although the choice was made"
            " by other episodes. Searches by `python -m agents.tune` now train with other seeds.",
            *_fewer(data),
            "- *Ten times as often*: `dt` is a tenth of the environment's. Episodes keep their length in"
            " seconds; running rewards and the chance of a kick are scaled with `dt`. Kicks, if any, are"
            " then different, and so is an agent's luck.",
            "- *Parameters*: each of the scene's parameters is made 20 % lower and higher, with the others"
            " unchanged; a moment of inertia that is not given follows from mass and size. The agents and the"
            " scale of scores remain those of the unchanged environment, so part of a loss or gain comes from"
            " the changed task itself.",
            "- *Noise*: Gaussian, drawn anew for each entry of the observation at each step, with a standard"
            " deviation of 1 % or 5 % of that of the entry under random actions (100 episodes).",
            "- *Late*: the agent sees the observation of the step before.",
            f"- Intervals: percentile bootstrap with {RESAMPLES:,} samples, with environments as strata and"
            " seeds as elements, as in rliable (Agarwal et al., NeurIPS 2021); tests compare our functions"
            " with rliable's. The probability of improvement compares runs: an agent that was"
            " not trained counts as one run. Learning curves use 20 test episodes with other seeds, and are"
            " linear between tests.",
            "- *First tests*: a run has 16 tests, so a score may have been reached up to a sixteenth of the"
            " run earlier, and the 20 episodes may be lucky. Seconds are processor time of training"
            " alone, on one core (wall time for policies from before November 2026)."
            " `python -m agents.race` tests more often, one run at a time.",
            *_together(data),
        ]
    )


def _together(data: Data) -> list[str]:
    """Return how long all runs of learners took."""
    agents = [agent for env in data["envs"].values() for agent in env["agents"].values()]
    learned = [agent for agent in agents if agent["kind"] == "learned"]
    runs = sum(len(agent["seeds"]) for agent in learned)
    hours = sum(agent["seconds"] * len(agent["seeds"]) for agent in learned) / 3600.0
    return [f"- All {runs:,} runs of learners took {hours:,.1f} hours of training."] if learned else []


def _fewer(data: Data) -> list[str]:
    """Return which agents were too slow to play all episodes."""
    found: dict[tuple[str, int], None] = {}
    for env_id, env in data["envs"].items():
        fewer = {}
        for name, agent in env["agents"].items():
            counts = [condition["episodes"] for condition in agent["conditions"].values()]
            if min(counts) < agent["conditions"][NOMINAL]["episodes"]:
                fewer[name] = min(counts)
        alike = len(fewer) == len(env["agents"]) > 1 and len(set(fewer.values())) == 1
        some = {f"all of {env_id}": n for n in fewer.values()} if alike else fewer
        found |= dict.fromkeys(some.items())
    if not found:
        return []
    names = ", ".join(f"{name} {n:,}" for name, n in found)
    return [
        f"- Under changed conditions some agents played fewer episodes: {names}. Their returns are corrected"
        " by the difference between the agent's return in these episodes and in all episodes, both without"
        " the change."
    ]


def _noise_table(envs: Mapping[str, Data]) -> str:
    rows = [
        [env_id, ", ".join(f"{entry} {value:.3g}" for entry, value in env["observation_std"].items())]
        for env_id, env in envs.items()
        if env.get("observation_std")
    ]
    return markdown_table(["environment", "standard deviation of each entry under random actions"], rows)


def _about(data: Data) -> str:
    machine = data["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in data["versions"].items())
    agents = [agent for env in data["envs"].values() for agent in env["agents"].values()]
    places = sorted({place for agent in agents for place in agent.get("trained_on", ())})
    trained = "\n".join(f"- {place}" for place in places)
    text = (
        f"Last measured on {machine['processor']}, {machine['cores']} cores, {machine['system']}, Python"
        f" {machine['python']}; {data['date']}. {versions}. Earlier rows were not measured"
        " again, and seconds of training may come from different processors."
    )
    return text + (f"\n\nTrained on:\n\n{trained}" if trained else "")


def _optimum(env_id: str) -> list[str]:
    """Return the results of `python -m agents.optimum`, with its picture."""
    if not (found := stored(OPTIMA / f"{env_id}.json")):
        return []
    bound, estimate, lower = found["bound"], found["estimate"], found["lower"]
    easier = "" if lower is not None else f" of {found['solved']}, which is easier,"
    if bound["exact"]:
        first = (
            f"It is known: {bound['value']:.4f} on average over the starts of {found['episodes']:,}"
            f" episodes, {bound['why']}. No policy exceeds it; a policy"
            " that acts at intervals falls just short."
        )
    else:
        first = f"The only proved upper bound is {bound['value']:.4g}: {bound['why']}."
    if estimate is None:
        second = f"Value iteration{easier} gives no estimate: its greedy policy gets more."
    else:
        second = (
            f"Value iteration{easier} estimates {plus_minus(estimate['value'], estimate['error'])} for the"
            f" starts of {found['episodes']:,} episodes. This value is extrapolated to zero cell width, and"
            " its error bar is how much the last halving of the cells changed it; it is not a proof."
        )
    parts = [first, second]
    if lower is not None:
        low, high = lower["interval"]
        parts.append(f"The greedy policy gets {lower['mean']:.6g} (95 % interval {low:.6g} to {high:.6g}).")
    known = known_returns(env_id)
    if known is not None and estimate is not None:
        upper = min(bound["value"], estimate["value"] + estimate["error"])
        if known.best - known.random < 0.95 * (upper - known.random):
            parts.append("**The range is too wide to call a score a percentage of the optimum.**")
    picture = DOCS / IMAGES / f"value-{env_id}.png"
    text = "**Optimum.** " + " ".join(parts)
    return [text, *([_image(picture.name, f"{env_id}: value function")] if picture.exists() else [])]


def adapter_rates() -> str:
    """Return the measurements of our `VecEnv` by `python -m agents.bench`."""
    found = json.loads(ADAPTER.read_text(encoding="utf-8"))
    text = (
        "`lag_envs.sb3.VecEnv` against Stable-Baselines3's `DummyVecEnv` over single environments:"
        f" {found['env']}, steps per second on one core of {found['machine']['processor']}, {found['date']};"
        f" medians of {found['rounds']} interleaved rounds (`python -m agents.bench`). Learning takes most of"
        " the time."
    )
    head = ["what", "environments", "adapter", "DummyVecEnv", "ratio"]
    return text + "\n\n" + markdown_table(head, map(rate_cells, found["rows"]))


def rate_cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the cells of a row of `agents.bench`: both medians and their ratio, or why there are none."""
    first = row["kind"], str(row["num_envs"])
    if row["problem"]:
        return *first, row["problem"]
    return *first, *(rate_text(quartiles(row[n])[1]) for n in ("adapter", "dummy")), f"{row['ratio'][1]:.1f}"


def _pooled(found: Data) -> str:
    """Return a value over several runs with its interval, if it has one."""
    low, high = found["interval"] or (None, None)
    return with_interval({"value": found["value"], "low": low, "high": high})


def _image(file: str, text: str) -> str:
    return f"![{text}]({IMAGES}/{file})"


def meaningful_digits(value: float) -> str:
    """Return a result with its meaningful digits.

    Examples
    --------
    >>> meaningful_digits(0.98765), meaningful_digits(-3.21), meaningful_digits(417.923)
    ('0.988', '-3.21', '417.9')
    """
    digits = 3 if abs(value) < 2.0 else 2 if abs(value) < 100.0 else 1
    text = f"{value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text


def with_interval(found: Mapping[str, float]) -> str:
    """Return a value with its interval, if it has one."""
    if found["low"] is None or math.isnan(found["low"]):
        return meaningful_digits(found["value"])
    value, low, high = (meaningful_digits(found[name]) for name in ("value", "low", "high"))
    return f"{value} ({low}, {high})"
