"""The report's plumbing: jobs, resuming, the page and its compact form; sections have their own tests."""

import csv
import json
import os
import pickle
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from covering import slow
from matplotlib.figure import Figure

from lag_envs.cli import main
from lag_envs.report import docs, page
from lag_envs.report.report import SECTIONS, NotAReport, ReportSettings, content_of, make_report, prepare
from lag_envs.report.runner import JobResult, load_results, module, run_jobs
from tests import dummy_section
from tests.dummy_section import job

PROJECT = Path(__file__).parents[1]


def settings(folder, **changes):
    return ReportSettings(str(folder), sections=(dummy_section.SECTION,), processes=1, **changes)


# --- jobs ---


def test_rows_in_the_order_of_the_jobs(tmp_path):
    results, complete = run_jobs(dummy_section.jobs(True), tmp_path, 2)
    assert complete
    assert [(r.name, [row["number"] for row in r.rows]) for r in results] == [
        ("two", [0, 1]),
        ("three", [0, 1, 2]),
    ]
    assert all(r.problem is None for r in results)


@pytest.mark.slow
def test_what_goes_wrong_costs_its_own_rows_only(tmp_path):
    told = []
    jobs = [
        job("fails", "fails"), job("hangs", "hangs", timeout=8.0), job("crashes", "crashes"),
        job("misses", "misses"), job("works", count=1),
    ]  # fmt: skip
    results, complete = run_jobs(jobs, tmp_path, 2, told.append)
    found = {r.name: r for r in results}
    assert complete and len(found) == 5
    assert found["fails"].problem == "ValueError: no such thing"
    assert found["hangs"].problem == "stopped after 8 s"
    assert "exit status 7" in found["crashes"].problem
    assert found["misses"].problem == "a_package_that_is_missing is not installed"
    assert found["works"].problem is None
    assert [len(found[name].rows) for name in ("fails", "hangs", "crashes", "works")] == [1, 1, 1, 1]
    assert len(told) == 4 and any("hangs: stopped" in line for line in told)


def test_finished_jobs_are_kept_and_failed_ones_tried_again(tmp_path):
    log = tmp_path / "log"
    jobs = [job("works", count=1, log=str(log)), job("fails", "fails")]
    run_jobs(jobs, tmp_path, 1)
    run_jobs(jobs, tmp_path, 1)
    assert log.read_text() == "x"
    assert [r.name for r in load_results(tmp_path / "results.jsonl")] == ["works", "fails", "fails"]
    run_jobs([replace(jobs[0], arguments={"count": 2, "log": str(log)})], tmp_path, 1)
    assert log.read_text() == "xx"  # other arguments, another job


def test_a_line_that_was_cut_off(tmp_path):
    jobs = [job("works", count=1), job("two", count=2)]
    run_jobs(jobs, tmp_path, 1)
    file = tmp_path / "results.jsonl"
    file.write_text(file.read_text()[:-30])
    results, _ = run_jobs(jobs, tmp_path, 1)
    assert [len(r.rows) for r in results] == [1, 2]
    assert [r.name for r in load_results(file)] == ["works", "two"]


@pytest.mark.slow
def test_timings_run_alone(tmp_path):
    alone = [replace(job(f"alone {i}", "waits", seconds=0.2), alone=True) for i in range(2)]
    begin = time.monotonic()
    results, _ = run_jobs([*alone, job("first", count=1)], tmp_path, 2)
    assert time.monotonic() - begin > 0.4
    assert load_results(tmp_path / "results.jsonl")[0].name == "first"
    assert len(results) == 3


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
@pytest.mark.parametrize("name", ["SIGINT", slow("SIGKILL")])
def test_interrupt_keeps_what_is_finished(tmp_path, name):
    code = (
        "from tests.dummy_section import job\n"
        "from lag_envs.report.runner import run_jobs\n"
        "from pathlib import Path\n"
        "if __name__ == '__main__':\n"
        "    jobs = [job('works', count=1), job('hangs', 'hangs', timeout=100.0)]\n"
        f"    results, complete = run_jobs(jobs, Path({str(tmp_path)!r}), 2)\n"
        "    print(len(results), complete)\n"
    )
    script = tmp_path / "script.py"
    script.write_text(code)
    path = os.pathsep.join([str(PROJECT), str(PROJECT / "tests"), os.environ.get("PYTHONPATH", "")])
    child = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
    )
    file = tmp_path / "results.jsonl"
    end = time.monotonic() + 60
    while time.monotonic() < end and not (file.exists() and load_results(file)):
        time.sleep(0.1)
    child.send_signal(getattr(signal, name))
    told = child.communicate(timeout=30)[0].split()
    assert told == (["1", "False"] if name == "SIGINT" else [])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["references", "results.jsonl", "script.py"]
    assert [r.name for r in load_results(file)] == ["works"]


# --- folder, page, tables ---


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    assert make_report(settings(folder, date="2026-01-02"))
    return folder


def test_everything_is_written(written):
    found = json.loads((written / "report.json").read_text(encoding="utf-8"))
    assert found["complete"] and found["settings"]["date"] == "2026-01-02"
    assert len(found["sections"][dummy_section.SECTION]["rows"]) == 5
    assert {"processor", "cores"} <= set(found["machine"]) and "numpy" in found["versions"]
    assert (written / "figures" / "dummy.svg").read_text().startswith("<?xml")
    assert (written / "figures" / "dots.png").read_bytes().startswith(b"\x89PNG")
    with (written / "tables" / "dummies.csv").open(newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["number", "of", "small"] and [float(row[2]) for row in rows] == [1e-16] * 5
    assert (written / "tables" / "all-dummies.csv").exists()


def test_page(written):
    text = (written / "index.html").read_text(encoding="utf-8")
    for part in ("Dummies &amp; more", "What &lt;b&gt;is&lt;/b&gt; said.", "There are five.", "5 found",
                 "A line. It goes up.", "figures/dummy.svg", "figures/dots.png", "Numbers &lt;of&gt; all",
                 "tables/dummies.csv", "tables/all-dummies.csv", "How many:", "2026-01-02"):  # fmt: skip
        assert part in text, part
    assert re.findall(r'class="(holds|fails|unknown)"', text) == ["holds", "unknown"]
    assert not re.findall(r"(?:src|href)=\"(?:https?:)?//", text)
    assert all(alt for alt in re.findall(r'<img [^>]*alt="([^"]*)"', text))
    assert '<html lang="en">' in text and "viewport" in text


@pytest.mark.slow
def test_page_tells_problems(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(dummy_section, "jobs", lambda quick: [job("fails", "fails")])
    assert make_report(settings(tmp_path))
    assert "fails: ValueError: no such thing" in (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "DOES NOT HOLD" in capsys.readouterr().out


def test_foreign_folder_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(NotAReport, match=r"thesis\.txt"):
        prepare(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_command_line_errors(tmp_path, capsys):
    (tmp_path / "thesis.txt").write_text("mine")
    for arguments, message in (
        (["report", str(tmp_path)], "holds other things"),
        (["report", str(tmp_path / "thesis.txt")], "thesis.txt is not a folder"),
        (["report", "--sections", "stabilty", str(tmp_path / "new")], "did you mean stability?"),
        (
            ["report", "--docs", "nowhere", str(tmp_path / "new")],
            f"--docs: {Path('nowhere/README.md')} is missing",
        ),
        (["report", "--quick", "--docs", ".", str(tmp_path / "new")], "--docs needs a full report"),
    ):
        assert main(arguments) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["report", "--processes", "0"])


def test_missing_package(monkeypatch, capsys):
    monkeypatch.setattr("lag_envs.commands.base.find_spec", lambda name: None if name == "mpmath" else 1)
    assert main(["report"]) == 2
    assert 'mpmath is missing: pip install "lag-envs[report]"' in capsys.readouterr().err


@pytest.mark.parametrize("name", SECTIONS)
def test_sections_stand_without_rows(name):
    """A report that was interrupted early still makes a page, and claims nothing; some tables tell why."""
    content = module(name).content([], [JobResult(name, "lost", "key", problem="stopped after 1 s")])
    assert content.title and content.text and not content.pictures
    assert [claim.text for claim in content.claims if claim.holds is not None] == []
    assert content.summary is None or not content.summary.rows
    told = name in ("environments", "work_precision", "bound", "stability")
    lines = [(line[0], line[-1]) for table in content.tables for line in table.rows]
    assert lines == [("lost", "stopped after 1 s")] * told
    assert all(len(line) == len(table.columns) for table in content.tables for line in table.rows)


@pytest.mark.parametrize("quick", [True, False])
@pytest.mark.parametrize("name", SECTIONS)
def test_jobs_can_be_sent(name, quick):
    jobs = module(name).jobs(quick)
    assert len({j.name for j in jobs}) == len(jobs) > 0
    for j in jobs:
        assert j.section == name and pickle.loads(pickle.dumps(j.function)) is j.function, j
        json.dumps(j.arguments, allow_nan=False)


# --- the compact form ---


def test_compact_form(written, tmp_path, monkeypatch):
    (tmp_path / "docs").mkdir()
    for name in ("speed.json", "speed-other.json", "gpu.json"):
        (tmp_path / "docs" / name).write_text((PROJECT / "docs" / name).read_text(encoding="utf-8"))
    names = ("bench", "fast", "other", "gpu")
    marks = {name: f"a <!-- {name}:begin --> <!-- {name}:end --> c" for name in names}
    (tmp_path / "README.md").write_text(marks["fast"])
    (tmp_path / "docs" / "speed.md").write_text("".join(marks.values()))
    monkeypatch.setattr(
        docs, "PARTS", (docs.PagePart(dummy_section.SECTION, "Dummies", "How many there are.", ("dots",)),)
    )
    monkeypatch.setattr(docs.overview, "draw_overview", lambda _: Figure())
    monkeypatch.setattr(docs.overview, "overview_sentences", lambda _: ["Nobody is faster."])
    monkeypatch.setattr(docs.overview, "faster_rivals", lambda _: [("1e-06", "2 of 7", "5e+13")])
    assert docs.main([str(written), str(tmp_path)]) == 0
    text = (tmp_path / "docs" / "accuracy-details.md").read_text(encoding="utf-8")
    assert "| There are five. | **holds** | 5 found |" in text
    assert "![A line](images/accuracy/dummy.svg)" in text
    page = (tmp_path / "docs" / "accuracy.md").read_text(encoding="utf-8")
    assert page.index("overview.png") < page.index("- Nobody is faster.") < page.index("## Dummies")
    assert "| 1e-6 | 2 of 7 | 5e13 |" in page, "exponents are written as people do"
    assert "images/accuracy/dots.png" in page and "dummy.svg" not in page
    assert "lag-envs report --sections tests.dummy" in page and "1 of 2 claims hold" in page
    for name in ("dots.png", "overview.png"):
        assert (tmp_path / "docs" / "images" / "accuracy" / name).exists()
    readme, speed = (tmp_path / name for name in ("README.md", "docs/speed.md"))
    assert " missed." in readme.read_text() and "`gym.make`" in speed.read_text(encoding="utf-8")
    assert readme.read_text().startswith("a ") and readme.read_text().endswith(" c")
    # Without the report's folder, the same from the committed file.
    readme.write_text(marks["fast"])
    monkeypatch.chdir(tmp_path)
    assert docs.main([]) == 0 and " missed." in readme.read_text()
    assert (tmp_path / "docs" / "accuracy.md").read_text(encoding="utf-8") == page
    # A report of one section leaves the others, and says where it was measured itself.
    stored, figures = tmp_path / "docs" / "accuracy.json", tmp_path / "docs" / "images" / "accuracy"
    whole = json.loads(stored.read_text(encoding="utf-8"))
    other = whole["sections"][0] | {"name": "other", "pictures": [{"file": "kept.svg", "caption": "Kept."}]}
    machine = whole["machine"] | {"processor": "Abacus"}
    stored.write_text(json.dumps(whole | {"machine": machine, "sections": [*whole["sections"], other]}))
    for name in ("kept.svg", "lost.svg"):
        (figures / name).write_text("<svg/>")
    assert docs.main([str(written), str(tmp_path)]) == 0
    found = json.loads(stored.read_text(encoding="utf-8"))
    assert found["machine"] == machine and found["sections"][1] == other
    assert found["sections"][0]["about"]["machine"] == whole["machine"]
    assert {path.name for path in figures.iterdir()} == {"kept.svg", "dots.png", "dummy.svg", "overview.png"}
    page = (tmp_path / "docs" / "accuracy.md").read_text(encoding="utf-8")
    assert page.count("*Measured apart from the other sections: ") == 1 == page.count("Abacus, ")


def test_without_a_report_or_its_compact_form(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert docs.main([]) == 2
    assert "docs/accuracy.json is not there; name a report's folder" in capsys.readouterr().err
    assert docs.main(["elsewhere"]) == 2
    assert "elsewhere holds no report.json; name a folder" in capsys.readouterr().err


def test_broken_off_report_is_not_taken_over(written, tmp_path, capsys):
    found = json.loads((written / "report.json").read_text(encoding="utf-8")) | {"complete": False}
    (tmp_path / "report.json").write_text(json.dumps(found))
    assert docs.main([str(tmp_path), str(tmp_path)]) == 2
    assert "not complete" in capsys.readouterr().err


# --- all of it ---


@pytest.mark.slow
def test_quick_report(tmp_path):
    """Every claim holds in a quick report, except that nobody is faster."""
    command = [sys.executable, "-m", "lag_envs.cli", "report", "--quick", str(tmp_path / "quick")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "quick" / "report.json").read_text(encoding="utf-8"))
    assert [p for part in found["sections"].values() for p in part["problems"]] == []
    claims = [claim for content in content_of(found).values() for claim in content.claims]
    assert [c for c in claims if c.holds is False and "in less time" not in c.text] == []
    assert sum(claim.holds is True for claim in claims) >= 20
    assert page.VERDICTS[True] in (tmp_path / "quick" / "index.html").read_text(encoding="utf-8")
