"""What the documentation says is what the code does: headings, tables, figures, links."""

import dataclasses
import inspect
import itertools
import json
import math
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from rollouts import IDS, make

from lag_envs.benchmark import TARGETS
from lag_envs.envs.program import BLOCK
from lag_envs.leaderboard.protocol import reference
from lag_envs.report.docs import generated
from lag_envs.report.environment_results import LARGEST_STEP
from lag_envs.report.episodes import play, random_actions
from lag_envs.report.reference import flow
from lag_envs.report.report import SECTIONS
from lag_envs.scenes import CylinderInCylinder, PivotedBar
from lag_envs.scores import known_returns
from lag_envs.stepping import pendulum
from lag_envs.tasks import TASKS, pivoted_bar
from lag_envs.tasks.measured import measured

ROOT = Path(__file__).parents[1]
HEADINGS = [
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
    "Optimal Value",
    "Version History",
]

each_id = pytest.mark.parametrize("env_id", IDS)


def sections(text):
    """Return a page's sections by heading, in order."""
    parts = re.split(r"^## (.+)$", inspect.cleandoc(text), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def table(text):
    """Return the first table's rows as dicts by column."""
    lines = (line.strip("| ") for line in text.splitlines() if line.startswith("|"))
    rows = [[cell.strip() for cell in line.split(" | ")] for line in lines]
    head, rule, *body = rows
    assert set("".join(rule)) <= set("-| ")
    return [dict(zip(head, row, strict=True)) for row in body]


def page(env):
    return sections(type(env.task).__doc__)


def plain(text):
    """Return a text without its line breaks."""
    return " ".join(text.split())


def agrees(stated, value):
    """Tell whether a stated number is the value, rounded to what is printed."""
    digits = len(stated.partition(".")[2])
    return abs(float(stated) - value) <= 0.5001 * 10.0**-digits + 1e-6 * abs(value)


# --- the tasks' pages ---


@each_id
def test_headings(env_id):
    env = make(env_id)
    assert list(page(env)) == HEADINGS
    assert env.__doc__ == type(env.task).__doc__
    assert all(text.strip() for text in page(env).values())


@each_id
def test_action_table(env_id):
    env = make(env_id)
    (row,) = table(page(env)["Action Space"])
    for column, action in (("At -1", -1.0), ("At 1", 1.0)):
        env.reset(seed=0, options={"state": env.task.centre})
        env.step(np.array([action]))
        assert env.control == float(row[column])
    assert env.scene.control_units == (row["Unit"],)


@each_id
def test_observation_table(env_id):
    env = make(env_id)
    rows = {row["Observation"]: row for row in table(page(env)["Observation Space"])}
    assert [name for name in rows if name in env.task.observation] == list(env.task.observation)
    space = env.observation_space
    for name, low, high in zip(env.task.observation, space.low, space.high, strict=True):
        assert agrees(rows[name]["Min"], low) and agrees(rows[name]["Max"], high), name


@each_id
def test_start_table(env_id):
    env = make(env_id)
    rows = {row["State"]: row for row in table(page(env)["Starting State"])}
    names = zip(
        env.scene.state_names, env.scene.state_units, env.task.centre, env.task.half_widths, strict=True
    )
    for name, unit, centre, half in names:
        row = rows[name]
        assert row["Unit"] == unit and agrees(row["Centre"], centre), name
        assert float(row["To either side"]) == pytest.approx(half), name
    if env.task.target_range is not None:
        assert float(rows["target"]["To either side"]) == env.task.target_range
    kicks = page(env)["Starting State"].count("kick")
    assert bool(kicks) == bool(env.task.draws)


@each_id
def test_episode_length(env_id):
    task = make(env_id).task
    assert f"after {task.steps} steps ({task.duration:g} s)" in plain(page(make(env_id))["Episode End"])


@pytest.mark.parametrize("kind", {t.__doc__: t for t in reversed([*TASKS.values()])}.values())
def test_argument_table(kind):
    """Every parameter that the task leaves free is there, with its default and its range."""
    task = kind()
    rows = {row["Keyword"]: row for row in table(sections(type(task).__doc__)["Arguments"])}
    fields = {field.name: field for field in dataclasses.fields(task.scene)}
    own = {"dt": task.dt, "duration": task.duration}
    if task.target_range is not None:
        own["target"] = None
    optional = {name for name in ("control", "tilt") if name in fields}
    assert set(fields) - optional <= set(rows) - set(own) <= set(fields)
    for name, row in rows.items():
        value = own[name] if name in own else getattr(task.scene, name)
        if isinstance(value, float):
            assert float(row["Default"]) == pytest.approx(value, rel=1e-5), name
        else:
            assert row["Default"] == str(value), name
        if name in fields and "unit" in fields[name].metadata:
            assert row["Unit"] == fields[name].metadata["unit"], name
        if name in task.usable_ranges():
            stated = [float(number) for number in row["Range"].split(" to ")]
            assert stated == pytest.approx(task.usable_ranges()[name], rel=1e-3), name


# --- figures ---


@each_id
def test_certified_speed(env_id):
    """The stated speed is the task's own, rounded down, and one series suffices up to it and no further."""
    env = make(env_id)
    scene, task, text = env.scene, env.task, plain(page(env)["Numerical Accuracy"])
    stated = re.search(r"\|θ'\| is at most ([\d.]+) rad/s", text)
    certified = task.certified_speed()
    order = scene.step_bound(task.centre, 0.0, task.dt).order
    if not order:
        assert stated is None and certified is None
        return
    assert f"order {order}." in text
    assert stated[1] == f"{math.floor(10.0 * certified) / 10.0:.1f}"
    top = task.limit_control
    (lowest,), _ = task.control_range
    controls = (lowest, 0.5 * (lowest + top), top)
    fastest = getattr(task, "fastest_shell", 0.0)

    def bounds(speed):
        for u, rate in itertools.product(controls, (-fastest, 0.0, fastest)):
            state = [0.0] * len(scene.state_names)
            state[scene._form.angle + 1] = speed
            if fastest:
                state[2] = rate
            yield scene.step_bound(state, u, task.dt)

    for speed in (0.0, 0.9 * certified, float(stated[1]), -certified):
        assert all(bound.substeps == 1 and bound.bounds["theta_dot"] <= 1e-12 for bound in bounds(speed))
    assert max(bound.substeps for bound in bounds(certified * (1.0 + 1e-9))) > 1


@each_id
def test_measured_error(env_id):
    """A step errs by less than 1e-15 of the state's size: the pages and README say so, as the report claims.

    Here some steps of an episode of random actions; the report's tests take all of them.
    """
    env = make(env_id)
    limit = f"{LARGEST_STEP:g}"
    assert f"against 40 digits: below {limit} of the state's size" in plain(page(env)["Numerical Accuracy"])
    assert f"no step of any of the eight environments errs by more than {limit} of" in plain(readme())
    assert f"errs by less than {limit} of the largest that each entry" in plain(numerics())
    scene = env.scene
    env.reset(seed=3)
    episode = play(env, random_actions(env, 3))
    sizes = np.maximum(1.0, np.abs(episode.states).max(axis=0))
    for i in np.linspace(0, len(episode.controls) - 1, 14).astype(int).tolist():
        before, control = episode.states[i], episode.controls[i]
        after = episode.states[i + 1]
        if env.task.draws:
            after = scene.simulate(before, [control], env.task.dt)[1]  # without a kick
        exact = flow(scene, before, control, env.task.dt)
        errors = [abs(float(a - b)) / size for a, b, size in zip(exact, after, sizes, strict=True)]
        assert max(errors) < LARGEST_STEP


def feedback(task):
    """Return the law that the page states, as a policy; None where there is none."""
    law = compile(task.examples.feedback or "None", "feedback", "eval")

    def policy(observations):
        seen = dict(zip(task.observation, observations.T, strict=True))
        return eval(
            law, {"clip": np.clip, "abs": np.abs, "where": np.where, "sin": np.sin, "cos": np.cos}, seen
        )

    return policy if task.examples.feedback else None


def returns(env_id, policy, episodes=4096):
    """Return mean and standard error of the first episodes of as many environments."""
    envs = gym.make_vec(env_id, num_envs=episodes)
    observations, _ = envs.reset(seed=1)
    total, going = np.zeros(episodes), np.ones(episodes, dtype=bool)
    while going.any():
        observations, rewards, terminations, truncations, _ = envs.step(policy(observations)[:, None])
        total += np.where(going, rewards, 0.0)
        going &= ~(terminations | truncations)
    return total.mean(), total.std() / math.sqrt(episodes)


@each_id
def test_stated_returns(env_id):
    """Random actions, zero control, and the page's feedback law return what the page says."""
    rng = np.random.default_rng(0)
    task = TASKS[env_id]()
    zero = task.rest_action
    policies = [lambda o: rng.uniform(-1.0, 1.0, len(o)), lambda o: np.full(len(o), zero)]
    policies += [law] if (law := feedback(task)) else []
    rows = {row["Id"]: row for row in table(page(make(env_id))["Optimal Value"])}
    _, *cells, best = rows[env_id].values()
    assert_measured(best, env_id, known_returns(env_id).policy)
    for cell, policy in zip(cells, policies, strict=True):
        stated, error = cell.split(" ± ")
        mean, standard_error = returns(env_id, policy)
        assert agrees(stated, mean) or abs(float(stated) - mean) <= standard_error, (mean, cell)
        assert agrees(error, standard_error), (standard_error, cell)


def scale(env_id):
    """Return what `python -m agents.scale` measured, by policy."""
    return measured(env_id)["measured"]


def assert_measured(cell, env_id, policy):
    """Hold a mean ± standard error against what was measured."""
    found, (mean, error) = scale(env_id)[policy], cell.split(" ± ")
    assert agrees(mean, found["mean"]) and agrees(error, found["error"]), (env_id, cell, found)


@each_id
def test_scale_is_what_was_measured(env_id):
    """It was set once; what was measured since lies within the errors of both, or it would mislead."""
    known, found = known_returns(env_id), scale(env_id)
    best = found[known.policy]
    assert known.error == pytest.approx(best["error"], rel=0.2)
    assert abs(known.best - best["mean"]) < 3.0 * known.error
    # What counts as random was set from fewer episodes.
    assert abs(known.random - found["random"]["mean"]) < 5e-3 * (known.best - known.random)
    if found_reference := reference(env_id):
        mean, error, episodes = found_reference[1:]
        assert (mean, error) == pytest.approx(
            (found["reference"]["mean"], found["reference"]["error"]), rel=0.05
        )
        assert abs(mean - found["reference"]["mean"]) < 0.1 * error
        assert episodes == found["reference"]["episodes"]
    assert (known.optimum is not None) == ("optimum" in found)
    if known.optimum is not None:
        assert known.optimum == pytest.approx(found["optimum"]["mean"], abs=1e-4)
        assert best["mean"] < found["optimum"]["mean"] < best["mean"] + 5e-4  # the same starts


# --- README and the other pages ---


def readme():
    return (ROOT / "README.md").read_text(encoding="utf-8")


def numerics():
    return (ROOT / "docs" / "numerics.md").read_text(encoding="utf-8")


def environments():
    """Return README's table of environments by id."""
    rows = table(readme().partition("## Environments")[2].partition("Keywords of")[0])
    return {re.match(r"\[([\w-]+)\]", row["id"])[1]: row for row in rows}


def test_readme_names_every_id():
    assert list(environments()) == IDS
    gallery = readme().partition("## ")[0]
    assert re.findall(r"docs/images/([\w-]+)\.png", gallery) == IDS


@each_id
def test_readme_row(env_id):
    """README's table repeats what page and measurements say."""
    env, row = make(env_id), environments()[env_id]
    best, _, optimum = row["best known"].partition("; optimum ")
    assert_measured(best, env_id, known_returns(env_id).policy)
    assert_measured(row["random"], env_id, "random")
    if optimum or "optimum" in scale(env_id):
        assert agrees(optimum, scale(env_id)["optimum"]["mean"])
    stated = re.search(r"is at most ([\d.]+) rad/s", plain(page(env)["Numerical Accuracy"]))
    assert row["certified"] == (stated[1] if stated else "exact")
    (control,) = table(page(env)["Action Space"])
    assert control["At 1"] in row["control"] and control["Unit"] in row["control"]
    assert len(row["observation"].split(", ")) == len(env.task.observation)


@pytest.mark.parametrize(
    "file", ["README.md", "CONTRIBUTING.md", *sorted(f"docs/{p.name}" for p in (ROOT / "docs").glob("*.md"))]
)
def test_links(file):
    path = ROOT / file
    text = path.read_text(encoding="utf-8")
    headings = {
        re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-")
        for h in re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    }
    for target in re.findall(r"\]\(([^)]+)\)", text):
        if target.startswith("#"):
            assert target[1:] in headings, target
        elif not target.startswith("http"):
            assert (path.parent / target).exists(), target


@pytest.mark.parametrize("file", ["README.md", "CONTRIBUTING.md"])
def test_make_targets(file):
    """Every ``make target`` that is named exists."""
    text = (ROOT / file).read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set(re.findall(r"`make ([a-z][a-z-]*)", text)) | set(
        re.findall(r"^make ([a-z-]+)", text, re.MULTILINE)
    )
    assert named and named <= targets


def test_generated_parts_are_as_generated():
    """README's tables and docs/accuracy.md follow from the JSON files beside them."""
    for path, text in generated(ROOT).items():
        assert path.read_text(encoding="utf-8") == text, (
            f"{path.name}: `make report ARGS='--docs .'` writes it anew"
        )


def test_speeds():
    """One table with all ids at four sizes; what misses its aim says so, and README claims no more."""
    speed = json.loads((ROOT / "docs" / "speed.json").read_text(encoding="utf-8"))
    assert speed["complete"]
    block = readme().partition("<!-- bench:begin -->")[2].partition("<!-- bench:end -->")[0]
    rows = {row.pop("id"): list(row.values()) for row in table(block)}
    assert list(rows) == [*IDS, "CartPole-v1", "*aim*"]
    aims = [float(cell.strip("*×")) for cell in rows["*aim*"]]
    assert aims == [target.ratio for target in TARGETS] and len(aims) == 4
    found = {(r["id"], r["kind"], r["num_envs"]): r for r in speed["rows"] if r["library"] == "lag_envs"}
    for env_id, target in itertools.product(IDS, TARGETS):
        cell = rows[env_id][TARGETS.index(target)]
        row = found[env_id, target.kind, target.num_envs]
        time, ratio = re.findall(r"([\d.,]+) ns.*?([\d.]+)×", cell)[0]
        assert float(time.replace(",", "")) == pytest.approx(1e9 / row["steps_per_second"][1], rel=6e-3)
        assert agrees(ratio, row["ratio"][1])
        assert ("missed" in cell) == (row["ratio"][1] < target.ratio)
        assert row["ratio"][1] > 1.0  # README's first sentence


def test_numbers_in_the_prose():
    """What README and docs/numerics.md say of the code's own numbers is so."""
    pages = {
        name: plain((ROOT / name).read_text(encoding="utf-8")) for name in ("README.md", "docs/numerics.md")
    }
    weight = make(pivoted_bar.SwingUpFree.id).scene._constants()["alpha"]
    doubling = math.log(2.0) / math.sqrt(weight)
    bar, brake = PivotedBar(), CylinderInCylinder(control="damping")
    assert brake._order(0.02) == bar._order(0.031)
    said = {
        "README.md": [
            f"doubles an error every {doubling:.2f} s",
            f"stepped in blocks of {BLOCK},",
            "more than a million substeps",
        ],
        "docs/numerics.md": [
            f"more than {pendulum.MAX_SUBSTEPS:,} substeps",
            f"blocks of {BLOCK} environments",
            f"order is {bar._order(0.03)}, and {bar._order(0.031)} for steps above 0.03 s and where",
        ],
    }
    assert pendulum.MAX_SUBSTEPS == 1_000_000
    assert [(page, text) for page, texts in said.items() for text in texts if text not in pages[page]] == []


def test_figures_of_the_report_are_there():
    text = (ROOT / "docs" / "accuracy.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"\]\((images/accuracy/[^)]+)\)", text))
    kept = {f"images/accuracy/{path.name}" for path in (ROOT / "docs" / "images" / "accuracy").iterdir()}
    assert shown == kept and shown


def test_committed_report_is_a_full_one():
    accuracy = json.loads((ROOT / "docs" / "accuracy.json").read_text(encoding="utf-8"))
    assert not accuracy["settings"]["quick"]
    assert [section["name"] for section in accuracy["sections"]] == list(SECTIONS)
    assert [section["problems"] for section in accuracy["sections"] if section["problems"]] == []
