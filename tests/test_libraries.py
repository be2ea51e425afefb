"""`make test-libraries`: its behaviour if something is missing or goes wrong, and the page that it writes."""

import hashlib
import json
import sys
from importlib import util
from pathlib import Path

import pytest

from lag_envs.generated import replaced

ROOT = Path(__file__).parents[1]
SPEC = util.spec_from_file_location("run_libraries", ROOT / "tools" / "libraries" / "__main__.py")
tool = util.module_from_spec(SPEC)
SPEC.loader.exec_module(tool)

SCRIPT = b"import sys\nenv_id = 'Pendulum-v1'\nprint('steps of', env_id)\n"
SOURCE = {
    "repository": "someone/something",
    "commit": "0" * 40,
    "files": {"examples/train.py": hashlib.sha256(SCRIPT).hexdigest()},
}
PROGRAMS = Path(sys.executable).parent


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setattr(tool, "HOME", tmp_path)
    monkeypatch.setattr(tool.urllib.request, "urlopen", refuse)
    kept = tmp_path / "scripts" / SOURCE["repository"] / SOURCE["commit"] / "examples" / "train.py"
    kept.parent.mkdir(parents=True)
    kept.write_bytes(SCRIPT)
    return kept


def refuse(*args, **options):
    raise OSError("no route to host")


def entry(**more):
    return {"what": "it", "commands": "python train.py", "source": SOURCE} | more


def test_a_run_with_another_id(home):
    tool.run("a", 0, entry(replace=[["Pendulum-v1", "PivotedBar-v0"]], expect=["of PivotedBar-v0"]), PROGRAMS)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"commands": "python train.py; exit 3"}, "exit status 3"),
        ({"commands": "false; python train.py"}, "exit status 1"),
        ({"expect": ["done"]}, "lacks 'done'"),
        ({"leaves": ["*.zip"]}, r"no \*.zip"),
        ({"replace": [["Acrobot-v1", "x"]]}, "occurs 0 times"),
        ({"replace": [["s", "x"]]}, "occurs 4 times"),
        ({"commands": "sleep 60"}, "not done after 0.5 s"),
    ],
)
def test_a_run_that_fails(more, message, monkeypatch):
    if "sleep" in more.get("commands", ""):
        monkeypatch.setattr(tool, "PATIENCE", 0.5)
    with pytest.raises(tool.Failed, match=message):
        tool.run("a", 0, entry(**more), PROGRAMS)


def test_scripts_that_cannot_be_had_or_are_others(home):
    home.write_bytes(SCRIPT + b"\n")
    with pytest.raises(tool.Failed, match="has the digest"):
        tool.run("a", 0, entry(), PROGRAMS)
    home.unlink()
    with pytest.raises(tool.NotRun, match=r"examples/train.py of someone/something could not be downloaded"):
        tool.run("a", 0, entry(), PROGRAMS)


def test_results_of_all_kinds_are_shown(monkeypatch, home):
    def install(name, library, wheel):
        if name == "c":
            raise tool.NotRun("not installed: no such version")
        return PROGRAMS

    monkeypatch.setattr(tool, "install", install)
    a = {"name": "A", "package": "pytest", "runs": [entry(), entry(commands="exit 1")]}
    rows = tool.test("a", a, Path())
    home.unlink()
    rows += tool.test("b", {"name": "B", "version": "0123abc", "runs": [entry()]}, Path())
    rows += tool.test("c", {"name": "C", "package": "pytest", "runs": [entry()]}, Path())
    assert [row["result"] for row in rows] == ["passed", "failed", "not run", "not run"]
    shown = tool.table({"python": "3", "system": "Linux", "date": "today", "rows": rows})
    assert shown.count("\n") == 7
    for text in ("passed, 0 s", "failed: exit status 1", "| 0123abc |", "not run: not installed: no such"):
        assert text in shown


def test_the_page_shows_the_results_of_every_library():
    found = json.loads(tool.RESULTS.read_text())
    page = tool.PAGE.read_text()
    assert replaced(page, "libraries", tool.table(found)) == page
    rows = [(row["key"], row["what"]) for row in found["rows"]]
    assert rows == [(n, run["what"]) for n, library in tool.libraries().items() for run in library["runs"]]


def test_what_is_installed_and_run_is_pinned():
    versions = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines()[2:])
    for name, library in tool.libraries().items():
        pins = dict(pin.split("==") for pin in library["pins"] if "==" in pin)
        assert pins.get("torch", versions["torch"]) == versions["torch"]
        assert "version" in library or any(p.split("[")[0] == library["package"] for p in pins), name
        for run in library["runs"]:
            source = run.get("source", {"commit": "0" * 40, "files": {}})
            assert len(source["commit"]) == 40 and all(len(d) == 64 for d in source["files"].values())
