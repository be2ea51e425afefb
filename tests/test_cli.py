"""The commands that show things: list, info, play, watch, new, completion; and every help."""

import argparse
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from covering import covering
from gymnasium.utils.env_checker import check_env

from lag_envs import TASKS, cli, own_files, play, watch
from lag_envs.errors import UserError
from lag_envs.leaderboard import shipped
from lag_envs.leaderboard.board import Board
from lag_envs.scores import score
from lag_envs.starter import filled
from lag_envs.tasks import acrobot, cart_pole, pivoted_bar

ROOT = Path(__file__).parents[1]
BALL = str(ROOT / "examples" / "ball_on_beam.py")
ID = "PivotedBar-v0"
FREE = pivoted_bar.SwingUpFree.id


@pytest.fixture
def window(monkeypatch):
    """A display without a screen."""
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield pygame
    pygame.display.quit()


def told(capsys, *arguments):
    """Run the command, which fails; return its message."""
    assert cli.main(arguments) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error and error.startswith("lag-envs: error: ")
    return error


# --- help ---


def parsers(parser, words):
    yield words, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, one in action.choices.items():
                yield from parsers(one, f"{words} {name}")


def test_every_help_has_examples_of_its_own_command():
    walked = dict(parsers(cli.parser(), "lag-envs"))
    assert {"lag-envs watch", "lag-envs leaderboard add"} <= set(walked) and len(walked) > 20
    for words, parser in walked.items():
        examples = parser.format_help().partition("\nexamples:\n")[2]
        assert re.search(rf"^\s+.*{words}\b", examples, re.M), words


def test_lines_of_help_fit_a_terminal(monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    for words, parser in parsers(cli.parser(), "lag-envs"):
        text = parser.format_help().partition("\nexamples:\n")[0]  # commands are to be copied whole
        assert max(map(len, text.splitlines())) <= 100, words


def test_examples_parse():
    """Each line of an example is one that the command accepts."""
    whole, count = cli.parser(), 0
    for parser in dict(parsers(whole, "lag-envs")).values():
        for line in (parser.epilog or "").replace("\\\n", "").splitlines():
            if line.startswith("  lag-envs "):
                call = re.split(r"\s{3,}(?![-\s])|\s>\s|\s\|\s", line.strip())[0]
                words = re.findall(r'"[^"]*"|\S+', call)[1:]
                if "--help" not in words:
                    whole.parse_args([word.strip('"') for word in words])
                    count += 1
    assert count > 40


def modules():
    """Return the modules that are run as ``python -m``, apart from `lag_envs.cli`."""
    for folder in ("agents", "src/lag_envs", "tools"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            parses = re.search(r"(ArgumentParser|module_parser)\(", text)
            if parses and '\nif __name__ == "__main__":' in text and path.stem != "cli":
                yield ".".join(path.relative_to(ROOT).with_suffix("").parts).removeprefix("src.")


@pytest.mark.slow
@pytest.mark.parametrize("module", list(modules()))
def test_every_module_that_is_run_has_help_with_examples(module, capsys):
    try:
        importlib.import_module(module).main(["--help"])
    except SystemExit as end:
        assert end.code == 0
    run = "make test-libraries" if module == "tools.libraries.__main__" else f"python -m {module}"
    assert re.search(rf"^  {run.removesuffix('.__main__')}\b", capsys.readouterr().out, re.M)


# --- errors and signals ---


def run_stub(body, **options):
    """Start a process whose command `list` does something else."""
    script = f"import os, sys, time\nfrom lag_envs import cli\ndef run(args):\n    {body}\n"
    script += "cli.COMMANDS = [command._replace(run=run) for command in cli.COMMANDS]\n"
    script += "sys.exit(cli.main(['list']))"
    return subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.PIPE, text=True, **options)


def test_no_option_is_abbreviated(capsys):
    with pytest.raises(SystemExit):
        cli.main(["cache", "--clea"])
    assert "unrecognized arguments: --clea" in capsys.readouterr().err


def test_a_report_has_no_ids(capsys):
    assert f"{ID} is an id, and the report measures all environments" in told(capsys, "report", ID)


@pytest.mark.skipif(os.name != "posix", reason="needs signals")
def test_sigterm_is_like_ctrl_c():
    body = "try:\n        print('begins', flush=True); time.sleep(60)\n    finally: print('tidies')"
    child = run_stub(body, stdout=subprocess.PIPE)
    assert child.stdout.readline() == "begins\n"
    child.terminate()
    assert child.communicate(timeout=60) == ("tidies\n", "") and child.returncode == 130


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("text", ["a", "a" * 100_000])
def test_a_full_output_is_told_in_a_line(text):
    with open("/dev/full", "w") as full:
        child = run_stub(f"print({text!r})", stdout=full)
        told = child.communicate(timeout=60)[1]
    assert (told, child.returncode) == ("lag-envs: error: No space left on device\n", 1)


@pytest.mark.skipif(os.name != "posix", reason="expects its words")
def test_what_the_system_refuses_is_told_in_a_line(tmp_path):
    child = run_stub(f"print('so far'); open({str(tmp_path)!r})", stdout=subprocess.PIPE)
    assert child.communicate(timeout=60) == ("so far\n", f"lag-envs: error: {tmp_path}: Is a directory\n")
    assert child.returncode == 1


# --- list, info ---


def test_an_encoding_that_lacks_a_character_gets_a_question_mark():
    poor = {**os.environ, "PYTHONIOENCODING": "ascii"}
    child = run_stub("print('m s⁻²')", stdout=subprocess.PIPE, env=poor)
    assert child.communicate(timeout=60) == ("m s??\n", "") and child.returncode == 0


def test_list_says_what_is_to_be_done(capsys):
    assert cli.main(["list"]) == 0
    out = capsys.readouterr().out
    assert "Swing a bar up by moving its support" in out and "lag-envs watch ID" in out
    choices = TASKS[cart_pole.CartPoleExact.id]().formulas.acting[0].values
    assert f"{cart_pole.CartPoleExact.id}  " in out and f" {choices[0]:g} or {choices[-1]:g} N " in out


def test_info_takes_a_module_and_tells_what_is_observed(capsys):
    assert cli.main(["info", f"lag_envs:{ID}"]) == 0
    assert re.search(r"theta_dot/8 .*rad/s  angular velocity, divided by 8", capsys.readouterr().out)


def test_python_runs_the_package():
    done = subprocess.run([sys.executable, "-m", "lag_envs", "--version"], capture_output=True, check=True)
    assert done.stdout.startswith(b"lag-envs ")


def test_info_names_the_agents(capsys):
    assert cli.main(["info", ID]) == 0
    out = capsys.readouterr().out
    for part in ("PPO  ", "comes with the package, score 0.9", "iLQR ", "--agent NAME", "the best known 419"):
        assert part in out, part
    assert cli.main(["info", BALL]) == 0
    assert "random  controller" in capsys.readouterr().out


def test_info_shows_imperfections_and_where_formulas_are(capsys):
    assert cli.main(["info", pivoted_bar.SwingUpUnknown.id]) == 0
    out = capsys.readouterr().out
    assert "observation_noise=0.01" in out and "pydoc lag_envs.tasks.pivoted_bar.SwingUpUnknown" in out
    assert cli.main(["info", BALL]) == 0
    out = capsys.readouterr().out
    assert "  off: randomize, observation_noise" in out and f"see {BALL}" in out
    assert cli.main(["info", acrobot.AcrobotReal.id]) == 0
    out = capsys.readouterr().out
    assert "leaderboards [1]:" in out and "\n[1] F. Wiebe" in out


# --- what ships ---


def test_what_ships_is_what_the_command_makes_of_the_board(tmp_path):
    """After a change of the board: python -m lag_envs.leaderboard.shipped."""
    made = shipped.ship(Board(ROOT / "leaderboard"), tmp_path)
    assert made == shipped.shipped() and set(made) <= set(TASKS)
    files = sorted(path.name for path in shipped.FOLDER.iterdir())
    assert files == sorted(path.name for path in tmp_path.iterdir())
    for name in files:
        assert (tmp_path / name).read_bytes() == (shipped.FOLDER / name).read_bytes(), name
    assert sum((tmp_path / name).stat().st_size for name in files) <= 2**20


def test_too_small_a_room_is_said():
    with pytest.raises(UserError, match="at most 10 bytes"):
        shipped.chosen_candidates([shipped.Candidate("A", 1.0, 90, "a", 0, "table")], 10)


def test_a_folder_without_a_board_is_refused(capsys, tmp_path):
    before = {path: path.read_bytes() for path in shipped.FOLDER.iterdir()}
    assert shipped.main(["--board", str(tmp_path)]) == 2
    assert f"there is no board in {tmp_path}" in capsys.readouterr().err
    assert before == {path: path.read_bytes() for path in shipped.FOLDER.iterdir()}


@pytest.mark.parametrize("env_id", covering(shipped.shipped()))
def test_what_ships_does_better_than_nothing(env_id):
    env, task = gym.make(env_id), TASKS[env_id]()
    agents = shipped.load(env_id), watch.load_agent(env_id, task, "zero")[1]
    played = [watch._episode(env, agent, 1, None, lambda env: False) for agent in agents]
    assert all(whole for _, whole, _ in played)
    assert score(env_id, played[0][0]) > score(env_id, played[1][0])


# --- watch ---


def test_watch_takes_agents_by_name_and_by_file(tmp_path):
    task = pivoted_bar.Balance()
    board = ROOT / "leaderboard"
    observation = np.zeros((1, 4), np.float32)
    entries = [e for e in Board(board).read().entries.values() if e.env == task.id and e.name == "PPO"]
    folder = Board(board).submission(entries[-1].id)
    files = [str(folder / file) for file in ("submission.toml", "policy_0.safetensors")]
    for name in (None, "ppo", "LQR", "zero", "random", str(folder), *files):
        _, agent = watch.load_agent(task.id, task, name)
        assert agent.predict(observation)[0].shape == (1, 1), name
    assert watch.load_agent(task.id, task, entries[-1].id, board)[0] == entries[-1].id
    for name, message in (
        (
            "pppo",
            "no such file (for an agent of a leaderboard, give the board's folder: --board FOLDER); did",
        ),
        (str(tmp_path), "is neither a model nor a folder with model.zip"),
        (str(board / "submissions" / "PivotedBar-v0-ppo-c1dc3900"), "an agent of PivotedBar-v0, not of Piv"),
    ):
        with pytest.raises(UserError, match=re.escape(message)):
            watch.load_agent(task.id, task, name)
    (tmp_path / "broken.zip").write_bytes(b"PK")
    with pytest.raises(UserError, match="nor a model of Stable-Baselines3"):
        watch.load_agent(task.id, task, str(tmp_path / "broken.zip"))
    (tmp_path / "model.zip").touch()
    (tmp_path / "result.json").write_text('{"env": "Other-v0"}')
    with pytest.raises(UserError, match=f"is an agent of Other-v0, not of {task.id}"):
        watch.load_agent(task.id, task, str(tmp_path))


def test_watch_takes_a_model_of_stable_baselines3(tmp_path):
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    envs = VecNormalize(DummyVecEnv([lambda: gym.make(ID)]))
    model = sb3.PPO("MlpPolicy", envs, n_steps=8, batch_size=8, device="cpu")
    envs.obs_rms.mean[:] = 0.25
    model.save(tmp_path / "model.zip")
    envs.save(str(tmp_path / "vecnormalize.pkl"))
    observation, task = np.ones(5, np.float32), TASKS[ID]()
    _, alone = watch.load_agent(ID, task, str(tmp_path / "model.zip"))
    _, whole = watch.load_agent(ID, task, str(tmp_path))
    assert alone.predict(observation)[0] == model.predict(observation, deterministic=True)[0]
    seen = envs.normalize_obs(observation)
    assert whole.predict(observation)[0] == model.predict(seen, deterministic=True)[0]
    with pytest.raises(UserError, match=rf"observes \(5,\) numbers, but {FREE} has 3"):
        watch.load_agent(FREE, TASKS[FREE](), str(tmp_path / "model.zip"))


def test_watch_opens_a_window_until_it_is_closed(window, capsys, monkeypatch):
    assert cli.main(["watch", ID, "--seed", "1", "--steps", "3"]) == 0
    assert f"{ID}: {shipped.shipped()[ID].name}\n" in capsys.readouterr().out
    assert cli.main(["watch", BALL, "--steps", "3", "--arrows", "--trail", "1", "--readout"]) == 0
    agent = watch.load_agent(ID, TASKS[ID](), "zero")[1]
    predict, seen = agent.predict, []

    def closing(*given, **named):
        seen.append(window.event.post(window.event.Event(window.QUIT)))
        return predict(*given, **named)

    monkeypatch.setattr(agent, "predict", closing)
    assert watch.watch(ID, agent, seed=1) == [] and len(seen) == 1


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_watch_writes_a_video(name, tmp_path, capsys):
    pytest.importorskip("moviepy")
    path = tmp_path / name
    assert cli.main(["watch", ID, "--seed", "1", "--steps", "30", "--video", str(path)]) == 0
    assert path.stat().st_size > 2000
    assert re.search(r"seed 1: return \S+\n", capsys.readouterr().out)
    if name.endswith("gif"):
        from PIL import Image

        with Image.open(path) as picture:
            assert picture.n_frames == 16 and picture.info["duration"] == 40


def test_watch_says_what_is_wrong(capsys, tmp_path, monkeypatch):
    assert "end with .mp4 or .gif, got a.avi" in told(capsys, "watch", ID, "--video", "a.avi")
    assert "the folder of" in told(capsys, "watch", ID, "--video", str(tmp_path / "no" / "a.gif"))
    assert "--seed must be at least 0, got -1" in told(capsys, "watch", ID, "--seed", "-1")
    assert "did you mean" in told(capsys, "watch", "PivotedBra-v0")
    assert "'Nope-v0'; `lag-envs list` names all" in told(capsys, "play", "Nope-v0")
    assert "--trail must be at most 60 s, got 100" in told(capsys, "watch", ID, "--trail", "100")
    assert "--trail must be at most 60 s, got 100" in told(capsys, "play", ID, "--trail", "100")
    assert "there is no board in nowhere" in told(capsys, "watch", ID, "--board", "nowhere")
    assert "did you mean iLQR?" in told(capsys, "watch", ID, "--agent", "ilqrr")
    monkeypatch.setenv("SDL_VIDEODRIVER", "nothing")
    assert "--video FILE" in told(capsys, "watch", ID)
    monkeypatch.setattr("lag_envs.commands.base.find_spec", lambda name: None)
    assert 'pip install "lag-envs[render]"' in told(capsys, "watch", ID)


# --- play ---


def test_play_tells_return_and_score(window, capsys, monkeypatch):
    monkeypatch.setitem(gym.registry[ID].kwargs, "duration", 0.2)
    assert cli.main(["play", ID, "--seed", "1", "--steps", "15"]) == 0
    first, second = capsys.readouterr().out.splitlines()[-2:]
    assert re.fullmatch(
        r"time is up: return -?[\d.e-]+, score -?[\d.]+ \(0 is random, 1 the best known\)", first
    )
    assert re.fullmatch(r"after 15 steps: return \S+", second)


def test_sticks_become_actions():
    crane, switched, _ = map(gym.make, own_files.registered(str(ROOT / "tests" / "own_tasks.py")))

    def action(env, *sticks, keys=()):
        rest = play.resting(env.unwrapped.task)
        return play.pressed_action(env.action_space, keys.__contains__, rest, sticks)

    # The second of the crane's controls goes from 0 to 20 N and rests at its lower end.
    assert action(crane, 0.5, 0.5).tolist() == [0.5, 0.0]
    assert action(crane, -0.05, -1.0).tolist() == [0.0, -1.0]
    assert action(crane, 0.5, 0.0, keys=("left",)).tolist() == [-1.0, -1.0]
    assert [action(switched, push) for push in (-1.0, -0.2, 0.0, 0.4, 0.9)] == [0, 1, 1, 1, 2]


def test_a_gamepad_may_come_and_go(window, monkeypatch, capsys):
    pads = []

    class Pad:
        def __init__(self, number):
            self.there = pads[number]

        def get_name(self):
            return "Pad"

        def get_numaxes(self):
            return 6

        def get_axis(self, i):
            if self.there not in pads:
                raise window.error("no such device")
            return [0.5, -0.25, 0.0, 1.0, 0.1, 0.1][i]

    monkeypatch.setattr(window.joystick, "get_count", lambda: len(pads))
    monkeypatch.setattr(window.joystick, "Joystick", Pad)
    gamepad = play.Gamepad()
    assert gamepad.sticks() == []
    pads.append("one")
    assert gamepad.sticks() == [0.5, 0.25, 0.0, -1.0]
    pads.clear()
    assert gamepad.sticks() == [] and gamepad.sticks() == []
    assert capsys.readouterr().out.splitlines() == ["gamepad: Pad", "gamepad unplugged; the keys still work"]
    gamepad.close()


# --- new ---


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A folder to write modules into, which are forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]
    own_files.load_module.cache_clear()


@pytest.mark.parametrize("name", ["my_scene", "scene", "swing_up", "task", "_", "parameter"])
def test_new_writes_what_runs(name, elsewhere, capsys):
    assert cli.main(["new", f"{name}.py"]) == 0
    assert f"lag-envs info {name}.py" in capsys.readouterr().out
    assert cli.main(["info", f"{name}.py"]) == 0
    assert "torque  -5 to 5 N m" in capsys.readouterr().out
    (id,) = own_files.registered(f"{name}.py")
    env = gym.make(id, length=2.0)
    check_env(env.unwrapped, skip_render_check=True)
    picture = gym.make(id, render_mode="rgb_array")
    picture.reset(seed=1)
    assert picture.render().std() > 1.0
    text = (elsewhere / f"{name}.py").read_text(encoding="utf-8")
    assert text == filled(name) and max(map(len, text.splitlines())) <= 110
    assert name in told(capsys, "new", f"{name}.py") and text == filled(name)


def test_new_says_what_is_wrong(elsewhere, capsys):
    (elsewhere / "there.py").write_text("mine")
    assert "there.py already exists" in told(capsys, "new", "there.py")
    assert (elsewhere / "there.py").read_text() == "mine"
    assert "must end with .py, as in swing.py" in told(capsys, "new", "swing")
    assert "one that Python can import" in told(capsys, "new", "my-scene.py")
    assert "one that Python can import" in told(capsys, "new", "class.py")
    assert "would hide an installed module" in told(capsys, "new", "numpy.py")
    assert "there is no folder" in told(capsys, "new", "no/my_scene.py")
    (elsewhere / "folder.py").mkdir()
    assert "already exists" in told(capsys, "new", "folder.py")


# --- completion ---


def completed(script, *words):
    """Return bash's completions for the last word."""
    line = " ".join(words)
    ask = (
        f"{script}\nCOMP_WORDS=({' '.join(repr(word) for word in words)}); COMP_CWORD={len(words) - 1}; "
        f"COMP_LINE={line!r}; COMP_POINT={len(line)}; _shtab_lag_envs 2>/dev/null; "
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, check=True, cwd=ROOT / "tests")
    return done.stdout.split()


def test_bash_completes_commands_options_ids_and_files(capsys):
    assert cli.main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    assert {"watch", "play", "new"} <= set(completed(script, "lag-envs", ""))
    assert completed(script, "lag-envs", "wat") == ["watch"]
    assert FREE in completed(script, "lag-envs", "watch", "PivotedBar")
    assert "own_tasks.py" in completed(script, "lag-envs", "info", "own_t")
    assert completed(script, "lag-envs", "watch", ID, "--ag") == ["--agent"]
    assert "withdraw" in completed(script, "lag-envs", "leaderboard", "w")


def test_other_shells_and_what_is_missing(capsys, monkeypatch):
    for shell in ("zsh", "tcsh"):
        assert cli.main(["completion", shell]) == 0
        assert ID in (out := capsys.readouterr().out) or shell == "tcsh"
        assert "watch" in out
    monkeypatch.setattr("lag_envs.commands.base.find_spec", lambda name: None)
    assert 'pip install "lag-envs[completion]"' in told(capsys, "completion", "bash")


def test_the_core_alone_lists(tmp_path):
    """Commands that only print text need no extra."""
    script = (
        "import sys\nfrom lag_envs import cli\n"
        "assert cli.main(['list']) == cli.main(['info', 'PivotedBar-v0']) == 0\n"
        "assert not {'pydantic', 'scipy.optimize', 'sympy', 'pygame', 'torch'} & set(sys.modules)\n"
    )
    subprocess.run(
        [sys.executable, "-c", script], check=True, capture_output=True, cwd=tmp_path, env=os.environ
    )
