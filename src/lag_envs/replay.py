"""Drives as links with seed and keys, and the command ``lag-envs replay``, which recomputes them.

A link ends with ``#drive=`` and seven fields separated by ``~``::

    1 ~ id ~ seed ~ keys ~ return ~ step ~ check

``1`` is the version of the format. The keys are the unpadded base64url of a sequence of integers, seven bits
to a byte, low bits first: for each run of equal keys, a number per control, then the length of the run. For a
control in [-1, 1] the number counts multiples of 1/`LEVELS`, encoded as 2n if positive and as -2n - 1 if
negative; a discrete action is encoded in the same way. The return, in full, is the 16 hexadecimal digits of a
double; the step is the digest of the script that made it (`lag_envs.envs.scripted`), and the check is the
CRC-32 of everything before it.

All numbers are recomputed by that script, whose bits are the same on every machine. So a claimed return is
either true or false, never approximately true.
"""

from __future__ import annotations

import argparse
import base64
import binascii
import math
import re
import struct
import zlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple
from urllib.parse import unquote

from lag_envs.errors import UserError, hint

VERSION = 1
#: Actions in [-1, 1] are multiples of one over this number, which float32 holds exactly.
LEVELS = 64
#: The longest link, and the longest drive that is recomputed.
LONGEST, MOST_STEPS = 200_000, 100_000
MARK = "drive="


class LinkError(UserError):
    """A damaged link, or something that is not a link."""


class Drive(NamedTuple):
    """The content of a link.

    Attributes
    ----------
    id : str
        The environment.
    seed : int
        Seed of the episode, in [0, 2^64).
    keys : str
        The keys, see `pack`.
    claimed : float
        The return that the link claims.
    step : str
        Digest of the script that made the drive.
    """

    id: str
    seed: int
    keys: str
    claimed: float
    step: str


class Replayed(NamedTuple):
    """The result of recomputing a drive.

    Attributes
    ----------
    total : float
        Its return.
    true : bool
        Whether it equals the claimed return in every bit.
    finished : bool
        Whether the episode ended with the last key; otherwise the driver stopped earlier.
    terminated : bool
        Whether the episode terminated before the time limit.
    score : float or None
        On the board's scale, if the environment has one and the episode is finished. A part of an episode has
        no score: where rewards are costs, it would look too good.
    """

    total: float
    true: bool
    finished: bool
    terminated: bool
    score: float | None


def write_link(drive: Drive, page: str = "") -> str:
    """Return the link of a drive, on a page.

    Examples
    --------
    >>> drive = Drive("PivotedBar-v0", 7, pack([(64,), (64,), (-3,)]), 0.5, "0123abcd")
    >>> write_link(drive)
    '#drive=1~PivotedBar-v0~7~gAECBQE~3fe0000000000000~0123abcd~dee8e247'
    >>> read_link(write_link(drive)) == drive
    True
    """
    claimed = struct.pack(">d", drive.claimed).hex()
    text = "~".join([str(VERSION), drive.id, str(drive.seed), drive.keys, claimed, drive.step])
    return f"{page}#{MARK}{text}~{zlib.crc32(text.encode()):08x}"


def read_link(link: str) -> Drive:
    """Return the content of a link.

    Raises
    ------
    LinkError
        If it is not a link of a drive, or is damaged; the text says what is wrong.
    """
    if len(link) > LONGEST:
        raise LinkError(f"the link has {len(link):,} characters; at most {LONGEST:,} are read")
    link = unquote(link)  # some programs write ~ as %7E
    text = link.strip().rpartition(MARK)[2]
    fields = text.split("~")
    if MARK not in link or len(fields) < 2:
        raise LinkError(
            f"{_short(link)} is not a link to a drive: it must hold #{MARK} and what follows; copy all of it"
        )
    if fields[0] != str(VERSION):
        raise LinkError(f"the link has version {_short(fields[0])}, but this program reads version {VERSION}")
    if len(fields) != 7:
        raise LinkError(f"the link is damaged: it has {len(fields)} fields, not 7; copy all of it")
    before, _, check = text.rpartition("~")
    if check != f"{zlib.crc32(before.encode(errors='replace')):08x}":
        raise LinkError("the link is damaged: its checksum does not match; copy all of it again")
    _, id, seed, keys, claimed, step, _ = fields
    if not re.fullmatch(r"0|[1-9][0-9]{0,19}", seed) or int(seed) >= 2**64:
        raise LinkError(
            f"the link's seed must be a whole number below 2^64, without leading zeros, got {_short(seed)}"
        )
    if not re.fullmatch(r"[0-9a-f]{16}", claimed):
        raise LinkError(f"the link's return must be 16 hexadecimal digits, got {_short(claimed)}")
    total = struct.unpack(">d", bytes.fromhex(claimed))[0]
    if not math.isfinite(total):
        raise LinkError(f"the link's return must be a finite number, got {total}")
    if not re.fullmatch(r"[0-9a-f]{8}", step):
        raise LinkError(f"the link's digest must be 8 hexadecimal digits, got {_short(step)}")
    if not re.fullmatch(r"[A-Za-z0-9_-]*", keys):
        raise LinkError("the link's keys hold characters that base64url does not have")
    if not keys:
        raise LinkError("the link's drive has no steps")
    return Drive(id, int(seed), keys, total, step)


def replay(drive: Drive | str, task: Any = None) -> Replayed:
    """Recompute a drive.

    Parameters
    ----------
    drive : Drive or str
        The drive, or its link.
    task : Task, optional
        The task, for an environment that is not part of the package.

    Raises
    ------
    LinkError
        If the link is damaged, or its drive is impossible.
    TypeError
        If the argument is neither a drive nor a link.
    """
    from lag_envs.envs.unfused import Unfused
    from lag_envs.mechanics.algebra import FormulaError
    from lag_envs.scenes import StepRefused
    from lag_envs.scores import score
    from lag_envs.tasks import TASKS

    drive = read_link(drive) if isinstance(drive, str) else drive
    if not isinstance(drive, Drive):
        raise TypeError(f"replay takes a Drive or the text of a link, got {drive!r:.80}")
    if task is None:
        if drive.id not in TASKS:
            raise LinkError(f"there is no environment {_short(drive.id)}; {hint(drive.id, TASKS)}")
        task = TASKS[drive.id]()
    try:
        env = Unfused(task)
    except FormulaError as error:
        raise LinkError(f"this drive of {drive.id} is impossible: {error}") from error
    if env.program.digest != drive.step:
        raise LinkError(
            f"the drive was made with another step ({drive.step}, here {env.program.digest}), by another "
            "version of lag_envs or of the environment; only that version can recompute its bits"
        )
    keys = drive_keys(drive, task)
    env.reset(drive.seed)
    total, terminated, over = 0.0, False, False
    for i, key in enumerate(keys):
        if over:
            raise LinkError(f"the episode ends after {i} steps, but the link has {len(keys)}: it is forged")
        try:
            _, reward, terminated, truncated = env.step(action_from_numbers(key, task))
        except StepRefused as error:
            raise LinkError(f"step {i + 1} cannot be taken: {error}") from error
        total, over = total + reward, terminated or truncated
    true = struct.pack(">d", total) == struct.pack(">d", drive.claimed)
    scored = score(drive.id, total) if over and drive.id in TASKS else None
    return Replayed(total, true, over, terminated, scored)


def action_from_numbers(key: Sequence[int], task: Any) -> Any:
    """Return the action for a step's numbers."""
    if task.formulas.choices:
        return key[0] if len(task.formulas.choices) == 1 else list(key)
    return [task.formulas.largest * (n / LEVELS) for n in key]


def drive_keys(drive: Drive, task: Any) -> list[tuple[int, ...]]:
    """Return a drive's keys, or raise a LinkError if they do not fit the task."""
    formulas = task.formulas
    keys = unpack(drive.keys, formulas.actions)
    choices = formulas.choices or (None,) * formulas.actions
    ranges = [(-LEVELS, LEVELS) if n is None else (0, n - 1) for n in choices]
    for i, key in enumerate(keys):
        for n, (low, high) in zip(key, ranges, strict=True):
            if not low <= n <= high:
                raise LinkError(f"key {i} of the link is {n}; it must lie between {low} and {high}")
    return keys


# --- keys as bytes ------------------------------------------------------------------------------------------


def pack(keys: Iterable[Sequence[int]]) -> str:
    """Return the keys of all steps, each with a number per control, as text."""
    runs: list[list[Any]] = []
    for key in keys:
        if runs and runs[-1][0] == tuple(key):
            runs[-1][1] += 1
        else:
            runs.append([tuple(key), 1])
    numbers = [m for key, count in runs for m in (*(2 * n if n >= 0 else -2 * n - 1 for n in key), count)]
    packed = bytearray()
    for m in numbers:
        while m >= 128:
            packed.append(m % 128 + 128)
            m //= 128
        packed.append(m)
    return base64.urlsafe_b64encode(packed).rstrip(b"=").decode()


def unpack(text: str, controls: int) -> list[tuple[int, ...]]:
    """Return the keys in a text, or raise a LinkError.

    Examples
    --------
    >>> unpack(pack([(64, 0), (64, 0), (-3, 1)]), 2)
    [(64, 0), (64, 0), (-3, 1)]
    """
    try:
        packed = base64.urlsafe_b64decode(text + "=" * (-len(text) % 4))
    except binascii.Error as error:
        raise LinkError(f"the link's keys are not base64url: {error}") from error
    numbers, value, shift = [], 0, 0
    for byte in packed:
        value += (byte % 128) << shift
        shift += 7
        if shift > 35:
            raise LinkError("the link's keys are damaged: a number is too long")
        if byte < 128:
            numbers.append(value)
            value = shift = 0
    if shift or len(numbers) % (controls + 1):
        raise LinkError("the link's keys are damaged: they end in the middle of a key")
    keys: list[tuple[int, ...]] = []
    for i in range(0, len(numbers), controls + 1):
        *key, count = numbers[i : i + controls + 1]
        if not 0 < count <= MOST_STEPS - len(keys):
            raise LinkError(f"the link has more than {MOST_STEPS:,} steps, or an empty run")
        keys += [tuple(m // 2 if m % 2 == 0 else -(m // 2) - 1 for m in key)] * count
    return keys


def _short(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:57] + "...")


# --- the command --------------------------------------------------------------------------------------------


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``replay``."""
    parser.add_argument("link", metavar="LINK", help="the link, or its part after #, in quotes")
    parser.add_argument("--file", metavar="FILE", help="your own Python file that defines the environment")


def run(args: argparse.Namespace) -> int:
    """Recompute a drive; return 0 if its claim is true, else 1."""
    drive = read_link(args.link)
    task = None
    if args.file:
        from lag_envs import own_files

        task = own_files.made_with_defaults(own_files.one(args.file), args.file)
        if drive.id != task.id:
            raise LinkError(f"the link is for {_short(drive.id)}, but {args.file} has {task.id!r}")
    found = replay(drive, task)
    steps = len(drive_keys(drive, task or _task(drive.id)))
    ending = (
        "terminated" if found.terminated else "its time is up" if found.finished else "stopped before its end"
    )
    print(f"{drive.id}, seed {drive.seed}, {steps} steps, {ending}")
    print(f"return {found.total!r}" + (f", score {found.score:.4f}" if found.score is not None else ""))
    print("true: every bit of the claim" if found.true else f"FALSE: the link claims {drive.claimed!r}")
    return 0 if found.true else 1


def _task(id: str) -> Any:
    from lag_envs.tasks import TASKS

    return TASKS[id]()
