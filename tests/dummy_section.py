"""A section of the report for tests: jobs that work, fail, hang and crash."""

import os
import time

from matplotlib.figure import Figure

from lag_envs.report.content import Claim, Content, ReportFigure, Table
from lag_envs.report.runner import ReportJob

SECTION = "tests.dummy_section"


def job(name, function="numbers", timeout=60.0, **arguments):
    return ReportJob(globals()[function], name, arguments, timeout)


def jobs(quick):
    return [job("two", count=2), job("three", count=3)]


def numbers(count, log=None):
    for i in range(count):
        yield {"number": i, "of": count}
    if log:
        with open(log, "a", encoding="utf-8") as file:
            file.write("x")


def fails():
    yield {"number": 1, "of": 2}
    raise ValueError("no such\n thing")


def hangs():
    yield {"number": 1, "of": 2}
    time.sleep(1000)


def waits(seconds):
    time.sleep(seconds)
    yield {"number": 0, "of": 1}


def crashes():
    yield {"number": 1, "of": 2}
    os._exit(7)


def misses():
    import a_package_that_is_missing  # noqa: F401

    yield {}


def content(rows, problems):
    def draw():
        figure = Figure()
        figure.subplots().plot([row["number"] for row in rows])
        return figure

    table = Table(
        "dummies",
        "Numbers <of> all",
        ("number", "of", "small"),
        [(r["number"], r["of"], 1e-16) for r in rows],
    )
    return Content(
        "Dummies & more",
        ["What <b>is</b> said."],
        [table],
        [
            ReportFigure("dummy", "A line. It goes up.", draw),
            ReportFigure("dots", "Dots.", draw, raster=True),
        ],
        [Claim("There are five.", len(rows) == 5, f"{len(rows)} found"), Claim("Nothing.", None, "")],
        Table("few", "How many:", ("rows",), [(len(rows),)]),
        [Table("all-dummies", "All of them", ("number",), [(row["number"],) for row in rows])],
    )
