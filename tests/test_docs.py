"""The documentation agrees with the code: headings, tables, figures, links."""

import ast
import dataclasses
import inspect
import itertools
import json
import math
import re
from functools import cache
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from covering import PERFECT, covering
from PIL import Image
from rollouts import IDS, RENDERS, make

from lag_envs.benchmark.targets import TARGETS
from lag_envs.envs.program import BLOCK
from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.protocol import reference
from lag_envs.leaderboard.standings import board_data
from lag_envs.mechanics.recording import parameter_names
from lag_envs.report.docs import generated
from lag_envs.report.environment_results import LARGEST_STEP
from lag_envs.report.episodes import endless_actions, record_episode
from lag_envs.report.overview import own_step
from lag_envs.report.reference import exact_flow
from lag_envs.report.report import SECTIONS
from lag_envs.scenes import CylinderInCylinder, PivotedBar
from lag_envs.scenes.derivation import form_of, layout_of, motion_constants_of, order_of
from lag_envs.scores import known_returns
from lag_envs.stepping import pendulum
from lag_envs.tasks import TASKS, pivoted_bar
from lag_envs.tasks.base import OF_ENVIRONMENTS
from lag_envs.tasks.measured import measured_entry
from tools.docs import environments, pictures
from tools.docs.__main__ import generated as from_records
from tools.docs.__main__ import main as write_docs
from tools.docs.equations import symbol
from tools.missing import have

ROOT = Path(__file__).parents[1]
each_id = pytest.mark.parametrize("env_id", covering())


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


def plain(text):
    """Return a text without its line breaks."""
    return " ".join(text.split())


def agrees(stated, value):
    """Return whether a stated number is the value, rounded to the printed digits."""
    digits = len(stated.partition(".")[2])
    return abs(float(stated) - value) <= 0.5001 * 10.0**-digits + 1e-6 * abs(value)


# --- the environments' pages, which are generated from their records ---


@pytest.fixture(scope="module")
def board():
    """The leaderboard's data."""
    return board_data(Board(ROOT / "leaderboard"))


@pytest.fixture(scope="module")
def page_of(board):
    """Return a function that returns an environment's page."""
    return cache(lambda env_id: environments.pages(board, ROOT, [env_id])[env_id])


@pytest.fixture
def page(env_id, page_of):
    """Return the environment's page."""
    return page_of(env_id)


def rows(page, heading, head):
    """Return a section's table by the entries of its second column, or of its first."""
    found = table(sections(page)[heading])
    return {row[head].split("`")[1] if "`" in row[head] else row[head]: row for row in found}


@pytest.mark.parametrize("env_id", TASKS)
def test_docstring_has_prose_only(env_id):
    """Tables are generated, from `quantities` among others."""
    task = TASKS[env_id]
    found = sections(task.__doc__)
    assert {"Description", "Rewards", "Version History"} <= set(found) <= set(environments.HEADINGS)
    quantities = task().quantities
    lacking = [name for name in task().observation if not all(quantities.get(name, [""]))]
    assert not lacking, f"{env_id}: quantities has no unit and meaning for {', '.join(lacking)}"
    assert "| --" not in task.__doc__
    assert make(env_id).__doc__ == task.__doc__


@each_id
def test_headings(env_id, page):
    found = sections(page)
    lacking = [name for name in environments.HEADINGS if not found.get(name, "").strip()]
    assert not lacking, f"the docstring of {env_id}'s task has nothing under: {', '.join(lacking)}"
    assert list(found) == list(environments.HEADINGS)


@each_id
def test_multiples_of_a_rounding_have_no_needless_digits(env_id, page):
    for told in re.findall(r"which is (\S+) times one rounding", page):
        assert "." not in told or len(told.replace(".", "").lstrip("0")) <= 3


@pytest.mark.parametrize("env_id", covering(PERFECT))
def test_action_table(env_id, page):
    """The controls at both ends of the action are those that a step applies."""
    env = make(env_id)
    found, space = rows(page, "Action Space", "Control"), env.action_space
    assert tuple(found) == tuple(env.task.action)
    assert {row["Unit"] for row in found.values()} <= set(env.scene.control_units)
    if env.task.formulas.choices:
        lists = [row["Values, by action"].split(", ") for row in found.values()]
        columns = [[float(value) for value in column] for column in zip(*lists, strict=False)]
        actions = [np.full(space.shape, i, space.dtype)[()] for i in range(len(columns))]
    else:
        top = f"{env.task.largest_action:g}"
        columns = [[float(row[f"At {sign}{top}"]) for row in found.values()] for sign in ("-", "")]
        actions = [space.low, space.high]
    for action, controls in zip(actions, columns, strict=True):
        env.reset(seed=0, options={"state": env.task.centre})
        env.step(action)
        assert np.atleast_1d(env.control).tolist() == controls


@each_id
def test_observation_table(env_id, page):
    env = make(env_id)
    found = rows(page, "Observation Space", "Observation")
    assert list(found) == list(env.task.observation)
    for row, low, high in zip(
        found.values(), env.observation_space.low, env.observation_space.high, strict=True
    ):
        for column, bound in (("Min", low), ("Max", high)):
            none = abs(bound) >= np.finfo(np.float32).max
            stated = row[column].replace("∞", "inf")
            assert float(stated) == (
                math.copysign(math.inf, bound) if none else pytest.approx(bound, rel=1e-3)
            )
        assert row["Unit"] and row["Meaning"]


@each_id
def test_start_table(env_id, page):
    """Starts lie in the box that the page states, and reach its edges."""
    task = make(env_id).task
    found = rows(page, "Starting State", "Entry")
    envs = gym.make_vec(env_id, num_envs=2000)
    envs.reset(seed=0)
    boxes = task.formulas.target_boxes
    names = [*task.scene.state_names, *(box.name for box in boxes)]
    columns = [*envs.unwrapped.state.T, *(np.reshape(envs.unwrapped.target, (2000, -1)).T if boxes else ())]
    for name, starts in zip(names, columns, strict=True):
        centre, half = float(found[name]["Centre"]), float(found[name]["To either side"])
        assert np.ptp(starts) == pytest.approx(2.0 * half, rel=0.01, abs=1e-12), name
        assert starts.mean() == pytest.approx(centre, abs=0.05 * half + 1e-4), name
    assert [found[name]["Unit"] for name in names] == [*task.scene.state_units, *(box.unit for box in boxes)]
    assert ("kick" in sections(page)["Starting State"]) == bool(task.draws)


@each_id
def test_episode_length(env_id, page):
    task = make(env_id).task
    end = f"after {task.limit:g} steps ({task.limit * task.dt:g} s)"
    assert end in sections(page)["Episode End"]


@each_id
def test_argument_table(env_id, page):
    """Every keyword is there, makes an environment with its default, and has the range that is enforced."""
    found = rows(page, "Arguments", "Keyword")
    task = make(env_id).task
    names = {field.name for field in dataclasses.fields(task.scene)}
    own = {"dt", "duration", "show_arrows", "show_trail", "show_readout"}
    own |= {"target"} if task.formulas.target_boxes else set()
    assert set(found) == names | own and all(row["Meaning"] for row in found.values())
    given = {name: ast.literal_eval(row["Default"]) for name, row in found.items()}
    again = gym.make(env_id, **given).unwrapped.task
    for name in names:
        value, default = getattr(again.scene, name), getattr(task.scene, name)
        assert value == (pytest.approx(default, rel=1e-4) if isinstance(default, float) else default), name
    for field in dataclasses.fields(task.scene):
        assert found[field.name]["Unit"] == field.metadata.get("unit", ""), field.name
    assert again.limit == task.limit
    assert "-∞" not in page.partition("## Arguments")[2].partition("## ")[0]
    positive = [name for name, row in found.items() if row["Range"].startswith(("above 0", "at least 0"))]
    for name in positive:
        with pytest.raises(ValueError, match=f"{name} must be"):
            gym.make(env_id, **{name: -1.0})


def test_usage_has_the_keywords_of_every_environment():
    text = sections((ROOT / "docs" / "usage.md").read_text("utf-8"))["Keywords of every environment"]
    for name in ("dt", "duration", "target", *OF_ENVIRONMENTS, "show_tiles"):
        assert re.search(rf"`{name}(=|`)", text), name


def as_python(latex):
    """Return a formula of the page as Python: with stars in products, theta_1 for theta_{1}, _dot for dot."""
    for pattern, text in (
        (r"\\(d+)ot\{\\?(\w+)\}(?:_\{(\d)\})?", lambda m: "_".join(filter(None, (m[2], m[3], f"{m[1]}ot")))),
        (r"\\mathrm\{([^}]*)\}", lambda m: m[1].replace("\\ ", "_")),
        (r"_\{(\w+)\}", r"_\1"),
        (r"\\(?=theta|phi|psi|sin|cos|arctan)", ""),
        (r"(sin|cos)\^\{2\} ?\{(.*?)\}", r"\1(\2)**2"),
        (r"\^\{2\}", "**2"),
        (r"(sin|cos) ?\{(.*?)\}", r"\1(\2)"),
        (r"(?<=[\w)]) (?=[\w(])", " * "),
    ):
        latex = re.sub(pattern, text, latex)
    return latex


@each_id
def test_equations(env_id, page):
    """The equations hold for the scene's accelerations, and the formula with numbers is the acceleration."""
    scene = make(env_id).scene
    head, *latex = re.findall(r"application/x-tex\">(.*?)</annotation>", page)
    free = layout_of(scene).free
    assert head.startswith(r"\mathcal{L} = ") and all(one.endswith("= 0") for one in latex[: len(free)])
    state = [0.3 + 0.1 * i for i in range(len(scene.state_names))]
    found = {
        name: float(value)
        for name, value in scene.acceleration(state, [0.7] * len(scene.control_names)).items()
    }
    values = dict(zip(scene.state_names, state, strict=True)) | dict.fromkeys(scene.control_names, 0.7)
    if "w" in values:  # the momentum's speed replaces the place's rate
        values["x_dot"] = values["w"] - scene.radius * values["phi_dot"]
    values |= {"sin": math.sin, "cos": math.cos, "arctan": math.atan, "phi_ddot": 0.0}
    if len(free) == 1:
        assert len(latex) == 2
        stated = eval(as_python(latex[1].partition("=")[2]), values)
        assert stated == pytest.approx(found[free[0]], rel=1e-4)
        return
    assert len(latex) == len(free)
    letters = {as_python(symbol(type(scene), name)): getattr(scene, name) for name in parameter_names(scene)}
    values |= letters | {f"{name}_ddot": value for name, value in found.items()}
    for one in latex:
        left = as_python(one.removesuffix("= 0"))
        assert abs(eval(left, values)) < 1e-12
        without = [eval(left, values | {f"{name}_ddot": 0.0}) for name in free if f"{name}_ddot" in left]
        assert without and min(map(abs, without)) > 1e-6


@pytest.mark.parametrize("env_id", covering(have("returns")))
def test_known_returns_and_agents(env_id, page, board):
    found = sections(page)
    known = measured_entry(env_id)["measured"]
    stated = {row["Policy"]: row for row in table(found["Known Returns"])}
    assert float(stated["random actions"]["Return"].split(" ")[0]) == pytest.approx(
        known["random"]["mean"], rel=1e-3
    )
    assert any(known_returns(env_id).policy in name for name in stated)
    rows = [row for one in board["environments"] if one["id"] == env_id for row in one["rows"]]
    if rows:
        assert table(found["Agents"])[0]["Rank"] == "1" and f"board/{env_id}.html" in found["Agents"]
    else:
        assert ("has no entries yet" in found["Agents"]) == bool(TASKS[env_id].goal)
    assert TASKS[env_id].note.strip() in found["Agents"]


# --- figures ---


@each_id
def test_certified_speed(env_id, page):
    """The stated speed is the task's own, rounded down, and one series suffices up to it and no further."""
    env = make(env_id)
    scene, task, text = env.scene, env.task, plain(sections(page)["Numerical Accuracy"])
    stated = re.search(r"\|`theta_dot`\| is at most ([\d.]+) rad/s", text)
    certified = task.certified_speed()
    order = scene.step_bound(task.centre, 0.0, task.dt).order
    if certified is None:  # a closed form, or a series that is certified when the step is known
        assert stated is None and (not order or form_of(scene) is None)
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
            state[form_of(scene).angle + 1] = speed
            if fastest:
                state[2] = rate
            yield scene.step_bound(state, u, task.dt)

    for speed in (0.0, 0.9 * certified, float(stated[1]), -certified):
        assert all(bound.substeps == 1 and bound.bounds["theta_dot"] <= 1e-12 for bound in bounds(speed))
    assert max(bound.substeps for bound in bounds(certified * (1.0 + 1e-9))) > 1


@pytest.mark.parametrize("env_id", covering(i for i in PERFECT if form_of(TASKS[i]().scene)))
def test_measured_error(env_id):
    """A step errs by less than 1e-15 of the state's size: README says so, as the report claims.

    Where several bars whip, a step is divided, and the motion amplifies roundings: the error may be larger by
    that factor. This test takes some steps of an episode of random actions; the report's tests take all of
    them.
    """
    env = make(env_id)
    limit = f"{LARGEST_STEP:g}"
    assert f"is below {limit} of the state's size in nine of them" in plain(readme())
    assert f"error is less than {limit} of the largest value that each entry" in plain(numerics())
    scene = env.scene
    env.reset(seed=3)
    episode = record_episode(env, endless_actions(env, 3))
    sizes = np.maximum(1.0, np.abs(episode.states).max(axis=0))
    for i in np.linspace(0, len(episode.controls) - 1, 14).astype(int).tolist():
        before, control = episode.states[i], episode.controls[i]
        after = episode.states[i + 1]
        if env.task.draws:
            after = scene.simulate(before, [control], env.task.dt)[1]  # without a kick
        exact = exact_flow(scene, before, control, env.task.dt)
        errors = [abs(float(a - b)) / size for a, b, size in zip(exact, after, sizes, strict=True)]
        grown = np.abs(scene.jacobian(before, control, env.task.dt)[0]) * sizes / sizes[:, None]
        attempts = scene.step_bound(before, control, env.task.dt).substeps
        times = 1.0 if form_of(scene) else attempts * max(1.0, grown.sum(axis=1).max())
        assert max(errors) < LARGEST_STEP * times


def scale(env_id):
    """Return the results of `python -m agents.scale`, by policy."""
    return measured_entry(env_id)["measured"]


@pytest.mark.parametrize("env_id", have("returns"))
def test_scale_is_what_was_measured(env_id):
    """The scale was set once; later measurements lie within the errors of both, or it would mislead."""
    known, found = known_returns(env_id), scale(env_id)
    best = found[known.policy]
    assert known.error == pytest.approx(best["error"], rel=0.2)
    assert abs(known.best - best["mean"]) <= 3.0 * known.error
    # The score of random actions was set from fewer episodes.
    assert abs(known.random - found["random"]["mean"]) < 5e-3 * (known.best - known.random)
    if found_reference := reference(env_id):
        mean, error, episodes = found_reference[1:]
        assert (mean, error) == pytest.approx(
            (found["reference"]["mean"], found["reference"]["error"]), rel=0.05
        )
        assert abs(mean - found["reference"]["mean"]) <= 0.1 * error
        assert episodes == found["reference"]["episodes"]
    assert (known.optimum is not None) == ("optimum" in found)
    if known.optimum is not None:
        assert known.optimum == pytest.approx(found["optimum"]["mean"], abs=1e-4)
        assert best["mean"] <= found["optimum"]["mean"] < best["mean"] + 5e-4  # the same starts


# --- README and the other pages ---


def readme():
    return (ROOT / "README.md").read_text(encoding="utf-8")


def numerics():
    return (ROOT / "docs" / "numerics.md").read_text(encoding="utf-8")


def test_readme_is_short_and_shows_what_it_must():
    text = readme()
    assert len(text.encode()) <= 8192
    block = text.partition("<!-- environments:begin -->")[2].partition("<!-- environments:end -->")[0]
    assert sorted(re.findall(r"`([\w-]+-v\d+)`", block)) == sorted(IDS)
    pictures = [ROOT / name for name in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)]
    assert len(pictures) == 2 and all(path.stat().st_size < 1_000_000 for path in pictures)
    for command in ("make demo", "make check"):
        assert re.search(rf"^{command}", text, re.MULTILINE)


def test_moving_pictures_are_small_and_move():
    folder = ROOT / "docs" / "images" / "moving"
    assert {path.stem for path in folder.iterdir()} == set(have("picture"))
    for path in folder.iterdir():
        assert path.stat().st_size <= pictures.LARGEST
        with Image.open(path) as picture:
            assert picture.n_frames > 20


def test_pictures_of_an_unknown_environment_are_refused(monkeypatch, capsys):
    monkeypatch.setattr("tools.docs.__main__.generated", None)
    with pytest.raises(SystemExit):
        write_docs(["--pictures", "PivotedBra-v0"])
    assert "did you mean PivotedBar-v0" in capsys.readouterr().err


@pytest.mark.skipif(not RENDERS, reason="pygame is not installed")
def test_a_replay_becomes_a_moving_picture(tmp_path):
    env_id = pivoted_bar.SwingUp.id
    states = [[0.0, 0.0, 0.1 * i, 0.5] for i in range(13)]
    replay = {"states": states, "actions": [[0.5]] * 12, "target": None}
    frames, seconds = pictures.frames(env_id, replay)
    pictures.write_animation(tmp_path / "a.webp", frames, seconds)
    with Image.open(tmp_path / "a.webp") as picture:
        assert picture.n_frames == len(frames) == 5 and picture.width == pictures.CHOICES[0][0]


#: Pages for readers of the repository; the site has more (`test_docs_site.py`), and its home links to them.
FILES = [
    *("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "NOTICE.md"),
    *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md") if path.name != "index.md"),
]


def anchors(path):
    """Return the anchors of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("file", FILES)
def test_links(file):
    path = ROOT / file
    for target in re.findall(r"\]\(([^)]+)\)", path.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            place, _, anchor = target.partition("#")
            found = path.parent / place if place else path
            assert found.exists(), target
            assert not anchor or anchor in anchors(found), target


@pytest.mark.parametrize("file", ["README.md", "CONTRIBUTING.md"])
def test_make_targets(file):
    """Every ``make target`` that is mentioned exists."""
    text = (ROOT / file).read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set(re.findall(r"`make ([a-z][a-z-]*)", text)) | set(
        re.findall(r"^make ([a-z-]+)", text, re.MULTILINE)
    )
    assert named and named <= targets


def test_generated_parts_are_as_generated():
    """Pages and README's tables are generated from the JSON files beside them, and from the records."""
    for path, text in generated(ROOT).items():
        assert path.read_text(encoding="utf-8") == text, (
            f"{path.name}: `python -m lag_envs.report.docs` writes it again"
        )
    for path, text in from_records(ROOT).items():
        assert path.read_text(encoding="utf-8") == text, (
            f"{path.name}: `python -m tools.docs` writes it again"
        )


def test_speeds():
    """A table with all ids at four sizes; it marks missed targets, and README claims no more."""
    speed = json.loads((ROOT / "docs" / "speed.json").read_text(encoding="utf-8"))
    assert speed["complete"]
    page = (ROOT / "docs" / "speed.md").read_text(encoding="utf-8")
    block = page.partition("<!-- bench:begin -->")[2].partition("<!-- bench:end -->")[0]
    first = next(part for part in block.split("\n\n") if part.startswith("| id | 1 "))
    rows = {row.pop("id"): list(row.values()) for row in table(first)}
    measured = have("speed")
    assert sorted(rows) == sorted(
        [*(env_id for env_id in IDS if env_id in measured), "CartPole-v1", "*target*"]
    )
    aims = [float(cell.strip("*×")) for cell in rows["*target*"]]
    assert aims == [target.ratio for target in TARGETS] and len(aims) == 4
    found = {(r["id"], r["kind"], r["num_envs"]): r for r in speed["rows"] if r["library"] == "lag_envs"}
    for env_id, target in itertools.product(have("speed"), TARGETS):
        cell = rows[env_id][TARGETS.index(target)]
        row = found[env_id, target.kind, target.num_envs]
        time, ratio = re.findall(r"([\d.,]+) ns.*?([\d.]+)×", cell)[0]
        assert float(time.replace(",", "")) == pytest.approx(1e9 / row["steps_per_second"][1], rel=6e-3)
        assert agrees(ratio, row["ratio"][1])
        assert ("missed" in cell) == (target.meant_for(row) and row["ratio"][1] < target.ratio)
    claim = "A step of `PivotedBar-v0` takes about a fifth of the"
    assert claim in (ROOT / "README.md").read_text(encoding="utf-8")
    assert found["PivotedBar-v0", TARGETS[0].kind, 1]["ratio"][1] > 5.0


def test_speeds_on_a_gpu():
    """Prose claims no more than was measured."""
    measured = json.loads((ROOT / "docs" / "gpu.json").read_text(encoding="utf-8"))
    rows = {(row["id"], row["precision"], row["num_envs"]): row for row in measured["rows"]}
    single, double = (rows["PivotedBar-v0", precision, 2**20] for precision in ("float32", "float64"))
    assert "H100" in measured["gpu"] and single["replayed"] >= 20e9 and double["replayed"] >= 10e9
    usage, readme, changes = (
        (ROOT / name).read_text(encoding="utf-8") for name in ("docs/usage.md", "README.md", "CHANGELOG.md")
    )
    assert "take 20 billion steps a second in float32 and 10 billion in float64" in usage
    assert f"at {100 * single['replayed_share']:.0f} % of the rate at which the memory can copy" in usage
    assert "20 billion steps a second" in readme and "20 billion steps a second" in changes
    assert {id for id, *_ in rows} <= set(TASKS)


def test_numbers_in_the_prose():
    """Statements on pages about the code's own numbers are true."""
    weight = motion_constants_of(make(pivoted_bar.SwingUpFree.id).scene)["alpha"]
    doubling = math.log(2.0) / math.sqrt(weight)
    bar, brake = PivotedBar(), CylinderInCylinder(control="damping")
    assert order_of(brake, 0.02) == order_of(bar, 0.031)
    accuracy = json.loads((ROOT / "docs" / "accuracy.json").read_text(encoding="utf-8"))
    ((own, _),), rivals = own_step(accuracy)
    assert 1e-12 in {error for time, error in rivals["DOP853"] if time < own}
    said = {
        "README.md": ["enough, DOP853, a Runge-Kutta method of order 8, is faster in the left panel."],
        "docs/accuracy.md": [f"doubles an error every {doubling:.2f} s", "more than a million substeps"],
        "docs/numerics.md": [
            f"more than {pendulum.MAX_SUBSTEPS:,} substeps",
            f"blocks of {BLOCK} environments",
            f"order is {order_of(bar, 0.03)} up to 0.03 s, {order_of(bar, 0.05)} up to 0.05 s and where the "
            f"control is a drag, and {order_of(bar, 0.051)} for longer steps",
        ],
    }
    assert pendulum.MAX_SUBSTEPS == 1_000_000
    found = {name: plain((ROOT / name).read_text(encoding="utf-8")) for name in said}
    assert [(page, text) for page, texts in said.items() for text in texts if text not in found[page]] == []


def test_figures_of_the_report_are_there():
    pages = [ROOT / "docs" / name for name in ("accuracy.md", "accuracy-details.md")]
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    shown = set(re.findall(r"\]\((images/accuracy/[^)]+)\)", text))
    kept = {f"images/accuracy/{path.name}" for path in (ROOT / "docs" / "images" / "accuracy").iterdir()}
    assert shown == kept and shown


def test_committed_report_is_a_full_one():
    accuracy = json.loads((ROOT / "docs" / "accuracy.json").read_text(encoding="utf-8"))
    parts = [accuracy, *(section["about"] for section in accuracy["sections"] if "about" in section)]
    assert not any(part["settings"]["quick"] for part in parts)
    assert [section["name"] for section in accuracy["sections"]] == list(SECTIONS)
    assert [section["problems"] for section in accuracy["sections"] if section["problems"]] == []
