"""Run every library that we name, with its own scripts, on our environments: ``make test-libraries``.

`libraries.toml` lists the packages to install, each library in its own virtual environment in
``.venv-libraries``, and the scripts to run. Scripts that no wheel contains are downloaded at a fixed commit
and checked against a digest. If a script or a library is not available, the table says so.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import urllib.request
from datetime import date
from pathlib import Path
from typing import Any

from lag_envs.generated import replaced
from lag_envs.tables import markdown_table

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
HOME = ROOT / ".venv-libraries"
RESULTS, PAGE = ROOT / "docs" / "libraries.json", ROOT / "docs" / "libraries.md"
#: Longest time of one run [s].
PATIENCE = 1200.0
#: No windows, no accounts, nothing written to the home folder.
QUIET = {
    "SDL_VIDEODRIVER": "dummy",
    "SDL_AUDIODRIVER": "dummy",
    "MPLBACKEND": "Agg",
    "WANDB_MODE": "disabled",
    "RAY_AUTH_MODE": "disabled",
    "RAY_USAGE_STATS_ENABLED": "0",
    "PYTHONUNBUFFERED": "1",
    # The networks are small, so threads would only wait for each other.
    "OMP_NUM_THREADS": "1",
}


class NotRun(Exception):
    """Raised if something that a run needs is not available; the text says what."""


class Failed(Exception):
    """Raised if a run failed; the text says how."""


def libraries() -> dict[str, Any]:
    """Return the table of libraries."""
    return tomllib.loads((HERE / "libraries.toml").read_text(encoding="utf-8"))


# --- environments and scripts ---


def install(name: str, library: dict[str, Any], wheel: Path) -> Path:
    """Make or update a library's virtual environment, with our wheel in it; return its folder of programs."""
    home = HOME / name
    python = home / "bin" / "python"
    pip = [python, "-m", "pip", "--quiet", "--disable-pip-version-check", "install"]
    stamp = home / "pins.json"
    pins = library["pins"]
    if not stamp.exists() or json.loads(stamp.read_text()) != pins:
        if not python.exists():
            _quietly([sys.executable, "-m", "venv", "--clear", home])
        _quietly([*pip, *pins])
        stamp.write_text(json.dumps(pins))
    # pip checks our requirements, unless a library pins older versions than they allow.
    _quietly([*pip, "--force-reinstall", "--no-deps", wheel])
    if not library.get("older", False):
        _quietly([*pip, wheel])
    return python.parent


def _quietly(command: list[Any]) -> None:
    done = subprocess.run([*map(str, command)], capture_output=True, text=True)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        raise NotRun(f"not installed: {(errors or [done.stderr.strip()[-200:]])[0]}")


def build_wheel() -> Path:
    """Return a wheel of this checkout."""
    folder = HOME / "wheel"
    shutil.rmtree(folder, ignore_errors=True)
    _quietly([sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, ROOT])
    return next(folder.glob("*.whl"))


def fetch(source: dict[str, Any], path: str, digest: str) -> bytes:
    """Return a file of a public repository at a commit, from an earlier download or a new one.

    Raises
    ------
    NotRun
        If it cannot be downloaded.
    Failed
        If it is not the expected file.
    """
    kept = HOME / "scripts" / source["repository"] / source["commit"] / path
    if kept.exists():
        data = kept.read_bytes()
    else:
        address = f"https://raw.githubusercontent.com/{source['repository']}/{source['commit']}/{path}"
        try:
            with urllib.request.urlopen(address, timeout=30.0) as answer:
                data = answer.read()
        except OSError as error:
            raise NotRun(f"{path} of {source['repository']} could not be downloaded ({error})") from error
    found = hashlib.sha256(data).hexdigest()
    if found != digest:
        raise Failed(f"{path} of {source['repository']} has the digest {found}, not {digest}")
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_bytes(data)
    return data


def scripts(entry: dict[str, Any]) -> dict[str, str]:
    """Return the files of a run by name, with replacements made in them."""
    source = entry.get("source", {"files": {}})
    texts = {Path(p).name: fetch(source, p, digest).decode() for p, digest in source["files"].items()}
    for old, new in entry.get("replace", []):
        places = [name for name, text in texts.items() for _ in range(text.count(old))]
        if len(places) != 1:
            raise Failed(f"{old!r} must occur once to be replaced, but occurs {len(places)} times")
        texts[places[0]] = texts[places[0]].replace(old, new)
    return texts


# --- runs ---


def run(name: str, number: int, entry: dict[str, Any], programs: Path) -> float:
    """Carry out one run in its own folder and return how long it took [s]."""
    folder = HOME / "runs" / f"{name}-{number}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for file_name, text in scripts(entry).items():
        (folder / file_name).write_text(text)
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment |= QUIET | {"HOME": str(folder), "SCRIPTS": str(HERE)}
    environment["PATH"] = f"{programs}{os.pathsep}{environment['PATH']}"
    output = folder / "output.txt"
    started = time.perf_counter()
    with output.open("w") as file:
        process = subprocess.Popen(
            ["sh", "-ec", entry["commands"]], cwd=folder, env=environment, stdin=subprocess.DEVNULL,
            stdout=file, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            status: int | None = process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            status = None
        finally:  # end all processes that it has left running
            try:
                os.killpg(process.pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
            process.wait()
    text = output.read_text(errors="replace")
    if status is None:
        raise Failed(f"not done after {PATIENCE:g} s; see {output}")
    if status:
        raise Failed(f"exit status {status}; see {output}\n{text[-1500:]}")
    for wanted in entry.get("expect", []):
        if wanted not in text:
            raise Failed(f"the output lacks {wanted!r}; see {output}")
    for file in entry.get("leaves", []):
        if not list(folder.glob(file)):
            raise Failed(f"there is no {file} in {folder}")
    return time.perf_counter() - started


def installed(programs: Path, package: str) -> str:
    """Return the version of a package in an environment."""
    code = "import sys; from importlib.metadata import version; print(version(sys.argv[1]))"
    done = subprocess.run(
        [programs / "python", "-c", code, package], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def test(name: str, library: dict[str, Any], wheel: Path) -> list[dict[str, Any]]:
    """Install a library, carry out its runs and return a row for each."""
    rows: list[dict[str, Any]] = [
        {"library": library["name"], "key": name, "what": entry["what"], "version": "", "gymnasium": ""}
        for entry in library["runs"]
    ]
    try:
        programs = install(name, library, wheel)
        version = library.get("version") or installed(programs, library["package"])
        gymnasium = installed(programs, "gymnasium")
    except NotRun as reason:
        return [row | {"result": "not run", "reason": str(reason)} for row in rows]
    for number, (row, entry) in enumerate(zip(rows, library["runs"], strict=True)):
        row |= {"version": version, "gymnasium": gymnasium}
        print(f"{library['name']}: {entry['what']} ...", flush=True)
        try:
            row |= {"result": "passed", "seconds": round(run(name, number, entry, programs))}
        except NotRun as reason:
            row |= {"result": "not run", "reason": str(reason)}
        except Failed as reason:
            row |= {"result": "failed", "reason": str(reason)}
        print(f"  {outcome(row)}", flush=True)
    return rows


# --- the page ---


def outcome(row: dict[str, Any]) -> str:
    """Return a run's outcome, in words."""
    if row["result"] == "passed":
        return f"passed, {row['seconds']} s"
    return f"{row['result']}: {row['reason'].splitlines()[0]}"


def table(found: dict[str, Any]) -> str:
    """Return the results as shown on the page."""
    about = f"Python {found['python']}, {found['system']}, {found['date']}; `make test-libraries`."
    rows = [
        [row["library"], row["version"], row["gymnasium"], row["what"], outcome(row)] for row in found["rows"]
    ]
    head = ["library", "version", "Gymnasium", "what was run", "result"]
    return f"{about}\n\n{markdown_table(head, rows)}"


def write_results(found: dict[str, Any]) -> None:
    """Write the results, and the table in the documentation."""
    RESULTS.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replaced(page, "libraries", table(found)), encoding="utf-8")


def main(arguments: list[str] | None = None) -> int:
    """Run all libraries, or some; return 1 if a run failed or if no run was possible."""
    known = libraries()
    parser = argparse.ArgumentParser(
        prog="make test-libraries ARGS=...",
        description="Run every library that we name, with its own scripts, on our environments.",
        epilog="examples:\n  make test-libraries ARGS=gymnasium\n  make test-libraries ARGS=--docs",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of {', '.join(known)} (default: all)")
    parser.add_argument("--docs", action="store_true", help="write the results into docs/libraries.md")
    args = parser.parse_args(arguments)
    for name in args.names:
        if name not in known:
            parser.error(f"there is no library {name!r}; available: {', '.join(known)}")
    HOME.mkdir(exist_ok=True)
    wheel = build_wheel()
    rows = [row for name in args.names or known for row in test(name, known[name], wheel)]
    if args.docs:
        # Libraries that were not run now keep their last result.
        old = json.loads(RESULTS.read_text())["rows"] if args.names and RESULTS.exists() else []
        rows_of = {n: [r for r in rows if r["key"] == n] or [r for r in old if r["key"] == n] for n in known}
        system = f"{platform.system()} {platform.machine()}"
        found = {"python": platform.python_version(), "system": system, "date": date.today().isoformat()}
        write_results(found | {"rows": [row for n in known for row in rows_of[n]]})
    print()
    for row in rows:
        print(f"{row['library']} {row['version']}: {row['what']}: {outcome(row)}")
    results = [row["result"] for row in rows]
    return int("failed" in results or "passed" not in results)


if __name__ == "__main__":
    sys.exit(main())
