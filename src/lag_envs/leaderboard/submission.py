"""Read and write a submission: a folder with ``submission.toml`` and arrays. No code in it is ever run.

Reading goes from the outside in: first the names and sizes of the files, then the text, then the header of
each file of arrays, and only then the arrays. Bad input is refused before more is read.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Self
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from lag_envs.envs.interface import plain_data
from lag_envs.errors import hint
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.architecture import Architecture
from lag_envs.leaderboard.fields import (
    Strict,
    accepted,
    ascii_text,
    between,
    length_between,
    line,
    shown_ascii,
)
from lag_envs.leaderboard.files import digest_of, read_plain
from lag_envs.leaderboard.log import load_json
from lag_envs.leaderboard.names import wordless
from lag_envs.leaderboard.policies import SubmittedPolicy, architecture
from lag_envs.leaderboard.protocol import Refused

__all__ = ["About", "Refused", "Submission", "about", "digest_of", "load", "read_files", "write"]

TOML = "submission.toml"
#: Upper limit of training seeds.
MOST_SEED = 10**9
POLICY = re.compile(r"policy_(0|[1-9][0-9]{0,8})\.safetensors")


@dataclass(frozen=True, kw_only=True)
class About:
    """The contents of ``submission.toml``, checked.

    Parameters
    ----------
    env, name : str
        As in the file.
    license : str
        The SPDX expression, with SPDX's capitals.
    kind : str
        "learned", "controller" or "optimal"; follows from the architecture.
    authors : tuple of str
        Who made it.
    digest : str
        SHA-256 of the names and contents of the folder's files.
    seeds : tuple of int
        Training seeds of the policies, increasing; (0,) for a built-in controller.
    architecture : Architecture
        The architecture, which takes the arrays.
    code, description : str
        Empty if not given.
    training : mapping
        ``{"env_steps", "seconds", "hardware", "curves": [{"seed", "steps": [...], "returns": [...]}]}``;
        empty if not given. All of it is claimed, not verified.
    """

    env: str
    name: str
    authors: tuple[str, ...]
    license: str
    kind: str
    digest: str
    seeds: tuple[int, ...]
    architecture: Architecture
    code: str = ""
    description: str = ""
    training: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Submission(About):
    """A submission whose every byte has been checked.

    Parameters
    ----------
    policies : tuple of (int, SubmittedPolicy)
        Training seed and policy, by increasing seed.
    folder : Path
        The folder it was read from.
    """

    policies: tuple[tuple[int, SubmittedPolicy], ...]
    folder: Path


# --- schema of submission.toml ------------------------------------------------------------------------------


Seed = Annotated[int, between(0, MOST_SEED - 1)]
Steps = Annotated[list[Annotated[float, between(0.0, 1e15)]], length_between(1, protocol.CURVE)]
Returns = Annotated[list[Annotated[float, between(-1e9, 1e9)]], length_between(1, protocol.CURVE)]


def _named(name: str) -> str:
    if wordless(name):
        raise ValueError("there must be a letter or a digit")
    return name


def _in_ids(name: str) -> str:
    if not re.search("[A-Za-z0-9]", name):  # ids on the board are made of these
        raise ValueError("there must be a letter from A to Z or a digit from 0 to 9")
    return name


def _licence(text: str) -> str:
    from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression

    try:
        return canonicalize_license_expression(text)
    except InvalidLicenseExpression:
        raise ValueError(
            "an SPDX expression is needed, such as MIT, CC-BY-4.0 or Apache-2.0 OR MIT; "
            "LicenseRef-NAME stands for any other licence"
        ) from None


def _address(code: str) -> str:
    # https://github.com@evil.org leads to evil.org.
    if "@" in urlsplit(code).netloc:
        raise ValueError("there must be no @ before the first / of the path: it would hide the real address")
    return code


def _on_a_board(env: str) -> str:
    if env not in (known := protocol.boards()):
        raise ValueError(f"there is no such board; {hint(env, known, 'lag-envs list names them')}")
    return env


class Curve(Strict):
    """A learning curve."""

    seed: Seed
    steps: Steps
    returns: Returns

    @model_validator(mode="after")
    def _fit(self) -> Self:
        if len(self.steps) != len(self.returns) or any(b <= a for a, b in pairwise(self.steps)):
            raise ValueError("steps must increase, one for each return")
        return self


class Training(Strict):
    """The table ``[training]``."""

    seeds: Annotated[list[Seed], length_between(0, protocol.MOST_POLICIES)] = Field(default=[])
    env_steps: Annotated[int, between(0, 10**15)]
    seconds: Annotated[float, between(0.0, 1e12)]
    hardware: Annotated[str, line(200)]
    curves: Annotated[list[Curve], length_between(0, protocol.MOST_POLICIES)] = Field(default=[])


class Toml(Strict):
    """The whole file."""

    version: Annotated[int, between(1, protocol.SCHEMA)] = Field(alias="schema")
    #: Decided by the board: earlier exports may state it, and it is ignored.
    stated: Annotated[int, between(1, 10**6)] = Field(default=1, alias="protocol")
    env: Annotated[str, AfterValidator(_on_a_board)]
    name: Annotated[str, line(60, least=1), AfterValidator(_in_ids)]
    authors: Annotated[list[Annotated[str, line(80, least=1), AfterValidator(_named)]], length_between(1, 20)]
    license: Annotated[str, line(60), AfterValidator(_licence)]
    code: Annotated[
        str,
        line(200),
        Field(pattern=r"^(https://[A-Za-z0-9._~:/?#@!$&*+,;=%-]+)?$"),
        AfterValidator(_address),
    ] = ""
    description: Annotated[str, line(500)] = ""
    #: Follows from the architecture, but may be stated too.
    kind: Any = None
    policy: dict[str, Any]
    training: Training | None = None


# --- reading ------------------------------------------------------------------------------------------------


def load(folder: Path | str) -> Submission:
    """Read a submission.

    Parameters
    ----------
    folder : Path
        The folder.

    Raises
    ------
    Refused
        For anything wrong with it; the text says what.
    """
    folder = Path(folder)
    files = read_files(folder)
    told = about(files)
    made = told.architecture
    policies: list[tuple[int, SubmittedPolicy]] = []
    for seed in told.seeds:
        name = f"policy_{seed}.safetensors"
        arrays = read_arrays(name, files[name], made) if made.arrays else {}
        policy = SubmittedPolicy(made, arrays)
        try:
            policy.agent()
        except Refused as error:
            raise Refused(f"{name}: {error}" if made.arrays else f"{TOML}: {error}") from error
        policies.append((seed, policy))
    numbers = sum(array.size for _, policy in policies for array in policy.arrays.values())
    if made.counts_as == "learned" and numbers > protocol.ALL_NUMBERS:
        raise Refused(
            f"the networks have {numbers:,} numbers together; at most {protocol.ALL_NUMBERS:,} are accepted"
        )
    if told.kind == "learned":
        _check_different(policies)
    return Submission(**vars(told), policies=tuple(policies), folder=folder)


def about(files: Mapping[str, bytes]) -> About:
    """Return the statements of a submission's files; the arrays are not looked at.

    Parameters
    ----------
    files : mapping of str to bytes
        The result of `read_files`.

    Raises
    ------
    Refused
        For anything wrong in ``submission.toml``.
    """
    told = accepted(Toml, _parse(files[TOML]), TOML)
    made = architecture(told.env, told.policy)
    if told.version < made.schema:
        raise Refused(f"{TOML}: this policy needs schema = {made.schema}, got {told.version}")
    found = sorted(int(match[1]) for name in files if (match := POLICY.fullmatch(name)))
    training = _training(told.training, found) if told.training else {}
    kind = _kind(made, bool(training), told.kind)
    if not made.arrays and found:
        raise Refused(f"policy_{found[0]}.safetensors: such a policy has no arrays; remove the file")
    least = protocol.LEARNED_POLICIES if kind == "learned" else 1
    if made.arrays and len(found) < least:
        raise Refused(f"there must be at least {least} policies (kind {kind}), got {len(found)}")
    return About(
        **told.model_dump(include={"env", "name", "license", "code", "description"}), kind=kind,
        authors=tuple(told.authors), digest=digest_of(files), seeds=tuple(found) if made.arrays else (0,),
        architecture=made, training=training,
    )  # fmt: skip


def read_files(folder: Path) -> dict[str, bytes]:
    """Return the files' contents by name; only plain files with the right names are opened.

    Raises
    ------
    Refused
        For other files, links, folders, and files that are too large.
    """
    try:
        if not stat.S_ISDIR(os.lstat(folder).st_mode):
            raise Refused(f"{shown_ascii(str(folder))} is not a folder (links are not followed)")
        with os.scandir(folder) as entries:
            names = [entry.name for entry, _ in zip(entries, range(protocol.MOST_POLICIES + 2), strict=False)]
    except OSError as error:
        raise Refused(f"{shown_ascii(str(folder))} cannot be read: {error.strerror}") from error
    for name in sorted(names):
        if name != TOML and not POLICY.fullmatch(name):
            raise Refused(
                f"unknown file {shown_ascii(name)}: only {TOML} and policy_<seed>.safetensors belong here"
            )
    if len(names) > protocol.MOST_POLICIES + 1:
        raise Refused(f"there are more than {protocol.MOST_POLICIES} policies")
    if TOML not in names:
        raise Refused(f"there is no {TOML}")
    sizes = {}
    for name in sorted(names):
        try:
            about = os.lstat(folder / name)
        except OSError as error:
            raise Refused(f"{name} cannot be read: {error.strerror}") from error
        if not stat.S_ISREG(about.st_mode):
            raise Refused(f"{name} is not a plain file; links, folders and devices are refused")
        most = protocol.TOML_BYTES if name == TOML else protocol.POLICY_BYTES
        if about.st_size > most:
            raise Refused(f"{name} has {about.st_size} bytes; at most {most} are accepted")
        sizes[name] = about.st_size
    if sum(sizes.values()) > protocol.FOLDER_BYTES:
        raise Refused(
            f"the files have {sum(sizes.values())} bytes; at most {protocol.FOLDER_BYTES} are accepted"
        )
    return {name: _read(folder / name, size) for name, size in sizes.items()}


def _read(file: Path, size: int) -> bytes:
    """Return a file's content; refuse a file that was replaced since it was looked at."""
    try:
        content = read_plain(file, size)
    except OSError as error:
        happened = "cannot be read" if isinstance(error, PermissionError) else "changed while it was read"
        raise Refused(f"{file.name} {happened}: {error.strerror}") from error
    if len(content) != size:
        raise Refused(f"{file.name} changed while it was read")
    return content


def _parse(content: bytes) -> dict[str, Any]:
    """Return the contents of a TOML file."""
    import tomllib

    try:
        text = content.decode()
    except UnicodeDecodeError as error:
        raise Refused(f"{TOML} is not UTF-8 text (byte {error.start})") from error
    # Parsing keys of many parts takes quadratic time.
    if any(len(line) > protocol.LINE for line in text.split("\n")):
        raise Refused(f"{TOML} has a line of more than {protocol.LINE} characters; break it")
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise Refused(f"{TOML} is nested too deeply") from error
    except Exception as error:  # not only TOMLDecodeError: numbers of too many digits, dates
        raise Refused(f"{TOML} is not valid TOML: {shown_ascii(str(error))}") from error


def _training(told: Training, found: list[int]) -> dict[str, Any]:
    """Return the table ``[training]``; `found` are the seeds of the policies."""
    if sorted(told.seeds) != found:
        raise Refused(
            f"{TOML}: training.seeds must be those of the policy files, {found}; got {sorted(told.seeds)}"
        )
    seeds = [curve.seed for curve in told.curves]
    if odd := [seed for seed in seeds if seed not in found or seeds.count(seed) > 1]:
        raise Refused(
            f"{TOML}: training.curves: seed must be one of {found}, each at most once, got {odd[0]}"
        )
    return told.model_dump(exclude={"seeds"})


def _kind(made: Architecture, trained: bool, stated: Any) -> str:
    """Return the kind, which follows from the architecture; refuse a different one that is stated."""
    kind = made.counts_as or ("learned" if trained else "controller")
    if stated not in (None, kind):
        raise Refused(
            f'{TOML}: kind must be "{kind}" for this architecture {"with" if trained else "without"}'
            f" [training], or left out, got {shown_ascii(stated)}"
        )
    if kind == "learned" and not trained:
        raise Refused(f"{TOML}: [training] is missing; learned policies need it")
    return kind


def _check_different(policies: Sequence[tuple[int, SubmittedPolicy]]) -> None:
    """Refuse the same learned policy under two seeds."""
    first: dict[bytes, int] = {}
    for seed, policy in policies:
        content = b"".join(policy.arrays[name].tobytes() for name in sorted(policy.arrays))
        if (other := first.setdefault(content, seed)) != seed:
            raise Refused(
                f"the policies of seeds {other} and {seed} are the same; each needs its own training"
            )


# --- arrays -------------------------------------------------------------------------------------------------


def read_arrays(name: str, content: bytes, made: Architecture) -> dict[str, NDArray[np.float64]]:
    """Return the arrays of a file, which must be those of the architecture."""
    from safetensors import SafetensorError
    from safetensors.numpy import load as read

    try:
        _check_header(content)
        found = read(content)
    except (SafetensorError, ValueError, KeyError) as error:
        raise Refused(
            f"{name} is not a safetensors file of the kind needed here: {ascii_text(error)[:200]}"
        ) from error
    _check_shapes(name, {key: array.shape for key, array in found.items()}, made)
    arrays = {}
    for key, array in found.items():
        if not np.isfinite(array).all():
            raise Refused(f"{name}: {key} has entries that are not finite")
        values = np.ascontiguousarray(array, np.float64)
        arrays[key] = np.where(np.abs(values) < protocol.TINY, 0.0, values)
        arrays[key].flags.writeable = False
    return arrays


def _check_header(content: bytes) -> None:
    """Refuse a header that the library would accept: too long, repeated keys, other types or extra fields."""
    size = int.from_bytes(content[:8], "little")
    if len(content) >= 8 and size > protocol.HEADER_BYTES:
        raise ValueError(f"its header must have at most {protocol.HEADER_BYTES} bytes, not {size}")
    if len(content) < 8 + size:
        raise ValueError(f"it is cut off after {len(content)} bytes")
    try:
        header = load_json(content[8 : 8 + size])
    except ValueError as error:
        raise ValueError(f"its header is not JSON ({error})") from error
    for key, entry in header.items() if isinstance(header, dict) else ():
        if not isinstance(entry, dict) or set(entry) != {"dtype", "shape", "data_offsets"}:
            raise ValueError(f"{ascii_text(key)} must have dtype, shape and data_offsets and nothing else")
        if entry["dtype"] not in ("F32", "F64"):
            raise ValueError(f"{ascii_text(key)} must be of F32 or F64, got {shown_ascii(entry['dtype'])}")


def _check_shapes(name: str, shapes: Mapping[str, tuple[int, ...]], made: Architecture) -> None:
    """Refuse arrays that do not fit the architecture."""
    if set(shapes) != set(made.arrays):
        odd = sorted(set(shapes) ^ set(made.arrays))[0]
        what = "is missing" if odd in made.arrays else "is not known"
        raise Refused(f"{name}: array {shown_ascii(odd)} {what}; the arrays must be {', '.join(made.arrays)}")
    lengths: dict[str, int] = {}
    for key, needed in made.arrays.items():
        shape = shapes[key]
        if len(shape) != len(needed):
            raise Refused(f"{name}: {key} must have {len(needed)} axes, got the shape {shape}")
        for n, wanted in zip(shape, needed, strict=True):
            if isinstance(wanted, str):
                of, _, more = wanted.partition(" + ")
                wanted = lengths.setdefault(of, max(n - int(more or 0), 2)) + int(more or 0)
            if n != wanted:
                raise Refused(f"{name}: {key} must have the shape {_told(needed, lengths)}, got {shape}")


def _told(shape: tuple[int | str, ...], lengths: Mapping[str, int]) -> str:
    def length(n: int | str) -> int | str:
        of, _, more = str(n).partition(" + ")
        return lengths[of] + int(more or 0) if of in lengths else n

    return "(" + ", ".join(str(length(n)) for n in shape) + ")"


# --- writing ------------------------------------------------------------------------------------------------


def write(
    folder: Path | str,
    *,
    env: str,
    name: str,
    authors: list[str] | tuple[str, ...],
    license: str,
    policy: Mapping[str, Any],
    kind: str = "",
    arrays: Mapping[int, Mapping[str, NDArray[Any]]] | None = None,
    training: Mapping[str, Any] | None = None,
    code: str = "",
    description: str = "",
) -> Submission:
    """Write a submission into a new folder, all or nothing, and return it as `load` reads it.

    Parameters
    ----------
    folder : Path
        Must not exist.
    env, name, authors, license, code, description
        See `About`.
    policy : mapping
        The table ``[policy]``.
    kind : str, optional
        The kind; refused unless it follows from the policy.
    arrays : mapping of int to mapping of str to ndarray
        For each training seed, the arrays, of float32 or float64; none for a built-in controller.
    training : mapping, optional
        The table ``[training]``, without ``seeds``.

    Raises
    ------
    Refused
        For anything that `load` would refuse.
    FileExistsError
        If the folder exists.
    """
    import tomli_w
    from safetensors.numpy import save

    folder, arrays = Path(folder), {} if arrays is None else arrays
    _check_kinds(env, authors, policy, arrays, training or {})
    for what, text in (
        ("name", name), ("license", license), ("kind", kind), ("code", code), ("description", description),
    ):  # fmt: skip
        if not isinstance(text, str):
            raise Refused(f"{what} must be a text, got {shown_ascii(text)}")
    if os.path.lexists(folder):
        raise FileExistsError(f"{folder} already exists")
    # State the oldest version that has such policies, so that a policy's files never change.
    schema = architecture(env, policy).schema if env in protocol.boards() else 1
    told: dict[str, Any] = {
        "schema": schema, "env": env, "name": name, "authors": list(authors), "license": license,
    }  # fmt: skip
    told |= {
        key: text for key, text in (("kind", kind), ("code", code), ("description", description)) if text
    }
    arrays = {
        plain_data(seed): {key: _array(f"arrays[{seed}][{key!r}]", array) for key, array in content.items()}
        for seed, content in arrays.items()
    }
    if training:
        told["training"] = {"seeds": sorted(arrays), **training}
    told["policy"] = dict(policy)
    try:
        table = tomli_w.dumps(plain_data(told))
    except TypeError as error:
        raise Refused(f"{TOML} cannot be written: {error}") from error
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        part = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(folder)) from error
    try:
        part.chmod(0o755)
        (part / TOML).write_text(table, encoding="utf-8", newline="\n")
        for seed, content in arrays.items():
            (part / f"policy_{seed}.safetensors").write_bytes(save(dict(content)))
        load(part)
        part.rename(folder)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    return load(folder)


def _array(name: str, given: Any) -> NDArray[Any]:
    """Return an array of numbers; `load` checks the rest."""
    try:
        array = np.ascontiguousarray(given)
    except ValueError:  # rows of different lengths
        raise Refused(f"{name} must be an array of float32 or float64, got {shown_ascii(given)}") from None
    if array.dtype.kind not in "fiu":
        raise Refused(f"{name} must be an array of float32 or float64, got one of {array.dtype}")
    return array


def _check_kinds(env: Any, authors: Any, policy: Any, arrays: Any, training: Any) -> None:
    """Refuse arguments of kinds that `write` does not document: a string would pass for a list of letters."""
    names = [authors] if isinstance(authors, str) else ["A. Author"]
    for what, given, kind, wanted in (
        ("env", env, str, "an environment's id, such as 'PivotedBar-v0'"),
        ("authors", authors, list | tuple, f"a list, such as {json.dumps(names)}"),
        ("policy", policy, Mapping, "a table, such as {'architecture': 'linear'}"),
        ("arrays", arrays, Mapping, "a mapping of training seeds to arrays by name"),
        ("training", training, Mapping, "a table, such as {'env_steps': 500000, ...}"),
    ):
        if not isinstance(given, kind):
            raise Refused(f"{what} must be {wanted}, got {shown_ascii(given)}")
    for seed, content in arrays.items():
        if not isinstance(content, Mapping):
            raise Refused(f"arrays[{seed}] must be a mapping of names to arrays, got {shown_ascii(content)}")
