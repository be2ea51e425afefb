"""The metadata for package indexes, citations and the conda recipe agree with the package."""

import re
import tomllib
from importlib.metadata import metadata
from pathlib import Path

import yaml
from trove_classifiers import classifiers

import lag_envs

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def load(name):
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


def requirements(lines):
    """Return requirements without the spaces in which pip and conda differ."""
    return sorted(re.sub(r"\s", "", line) for line in lines)


def test_one_version():
    recipe, citation = load("recipe/recipe.yaml"), load("CITATION.cff")
    assert PROJECT["version"] == lag_envs.__version__ == recipe["context"]["version"] == citation["version"]
    assert PROJECT["license"] == recipe["about"]["license"] == citation["license"]
    assert PROJECT["urls"]["Repository"] == recipe["about"]["repository"] == citation["repository-code"]
    assert PROJECT["description"] == recipe["about"]["summary"]


def test_conda_asks_for_what_pip_asks_for():
    recipe = load("recipe/recipe.yaml")
    run = requirements(recipe["requirements"]["run"])
    assert run == requirements([*PROJECT["dependencies"], f"python{PROJECT['requires-python']}"])
    (script,) = recipe["build"]["python"]["entry_points"]
    assert script == "lag-envs = " + PROJECT["scripts"]["lag-envs"]


def test_readme_links_to_pages_that_a_package_index_reaches():
    links = re.findall(r"\]\(([^)]+)\)", metadata("lag-envs").get_payload())
    assert len(links) > 20
    assert not [link for link in links if not link.startswith(("https://", "#"))]
    assert any(link.endswith(".png") and "//raw." in link for link in links)


def test_classifiers_are_known_and_tested():
    """`make setup` accepts each Python, and the workflow runs the tests on each of them and each system."""
    assert set(PROJECT["classifiers"]) <= classifiers
    setup = (ROOT / "tools" / "setup").read_text(encoding="utf-8")
    oldest, newest = (
        int(re.search(rf"^{which}=3\.(\d+)", setup, re.MULTILINE)[1]) for which in ("oldest", "newest")
    )
    stated = re.findall(r"Python :: 3\.(\d+)", " ".join(PROJECT["classifiers"]))
    assert [int(minor) for minor in stated] == list(range(oldest, newest + 1))
    assert PROJECT["requires-python"] == f">=3.{oldest}"
    systems = {"ubuntu": "Linux", "macos": "MacOS", "windows": "Windows"}
    matrix = load(".github/workflows/tests.yml")["jobs"]["tests"]["strategy"]["matrix"]
    assert matrix["python"] == [f"3.{minor}" for minor in stated]
    known = {
        name for c in PROJECT["classifiers"] if "Operating System" in c for name in [c.split(" :: ")[-1]]
    }
    assert known == {systems[runner.split("-")[0]] for runner in matrix["os"]}


def test_a_release_is_published_only_when_switched_on():
    jobs = load(".github/workflows/release.yml")["jobs"]
    assert jobs["publish"]["if"] == "vars.PUBLISH == 'true'"
    assert jobs["publish"]["needs"] == "build"
    assert jobs["publish"]["permissions"] == {"id-token": "write"}


def test_entry_for_gymnasium_names_the_oldest_gymnasium():
    text = (ROOT / "docs" / "gymnasium-list.md").read_text(encoding="utf-8")
    (gymnasium,) = (d for d in PROJECT["dependencies"] if d.startswith("gymnasium"))
    assert f"Gymnasium-v{re.search(r'>=([0-9.]+)', gymnasium)[1]}-" in text
