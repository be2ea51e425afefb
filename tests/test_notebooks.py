"""The notebooks run from the first cell to the last, wherever the package is installed."""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

pytest.importorskip("ipykernel")
nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
NAMES = [path.stem for path in NOTEBOOKS]

pytestmark = pytest.mark.filterwarnings("ignore")  # of the libraries that run notebooks


def run(path, folder, **environment):
    """Run a notebook in a folder without anything from the clone; return it with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    # Not the whole environment: the test command's variables do not concern the notebook.
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST", "MPL"))}
    client = nbclient.NotebookClient(notebook, timeout=1800, kernel_name="python3")
    client.execute(cwd=str(folder), env={**kept, **environment})
    return notebook


def texts(notebook):
    """Return all output of the cells, as text."""
    return json.dumps([cell.get("outputs", []) for cell in notebook.cells])


def test_there_are_three():
    assert NAMES == ["derive_and_verify", "first_steps", "train_and_submit"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMES)
def test_notebooks_lie_without_outputs(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    for cell in notebook.cells:
        assert not cell.get("outputs") and cell.get("execution_count") is None and not cell.metadata
        assert "http" not in cell.source.replace("https://github.com/lag-envs/lag-envs", "")
        # Private names change without notice.
        assert not re.search(r"\w\._[a-z]", cell.source), cell.source
    assert "pip install" in notebook.cells[0].source and "clone" in notebook.cells[0].source


@pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMES)
def test_notebooks_run(path, tmp_path):
    """With few steps and episodes; in full under -m slow."""
    found = texts(run(path, tmp_path, LAG_ENVS_QUICK="1"))
    assert {
        "first_steps": "the best known",
        "derive_and_verify": "<math",
        "train_and_submit": "worst disturbance",
    }[path.stem] in found
    assert "image/png" in found


@pytest.fixture(scope="session")
def wheel():
    """The package from its wheel, unpacked beside its dependencies."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*command, "--no-deps", "--target", folder, ROOT], check=True)
        yield folder


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMES)
def test_notebooks_run_in_full_from_the_wheel(path, tmp_path, wheel):
    begin = time.perf_counter()
    probe = tmp_path / "probe.ipynb"
    cell = nbformat.v4.new_code_cell("import lag_envs; print(lag_envs.__file__)")
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), probe)
    assert wheel in texts(run(probe, tmp_path, PYTHONPATH=wheel))
    run(path, tmp_path, PYTHONPATH=wheel)
    print(f"{path.stem}: {time.perf_counter() - begin:.0f} s")
