"""The stored result of a verification: its schema, and how two results are compared."""

from __future__ import annotations

import gzip
import io
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.fields import Strict, ascii_text, checked
from lag_envs.leaderboard.files import digest_of
from lag_envs.leaderboard.log import EnvId, Hash, Number, Text, load_json

#: Largest result [bytes], packed and unpacked.
PACKED, UNPACKED = 2**25, 2**28
Count = Annotated[int, Field(ge=0, le=2**63)]


class PolicyResult(Strict):
    """A policy's episodes, in the order of their seeds."""

    seed: Count
    returns: list[Number]
    success: list[bool]
    settle: list[Number | None]
    effort: list[Number]
    trajectory: Hash
    reference: list[Number] | None = None


class Replay(Strict):
    """A recorded episode."""

    label: Literal["median", "best", "worst"]
    seed: Count
    reset_seed: Count
    return_: Number = Field(alias="return")
    dt: Annotated[float, Field(gt=0.0)]
    states: Annotated[list[list[Number]], Field(min_length=1, max_length=100_000)]
    actions: list[Number] | list[list[Number]]
    rewards: list[Number]
    target: Number | list[Number] | None

    @model_validator(mode="after")
    def _fit(self) -> Self:
        if not len(self.states) - 1 == len(self.actions) == len(self.rewards):
            raise ValueError("there must be an action and a reward for each step")
        return self


class ClaimedCurve(Strict):
    """A learning curve."""

    seed: Count
    steps: list[Number]
    returns: list[Number]


class Claimed(Strict):
    """A submission's unverified statements about itself."""

    code: Text | None
    license: Text
    description: Text
    env_steps: Number | None
    seconds: Number | None
    hardware: Text | None
    curves: list[ClaimedCurve]


class VerificationResult(Strict):
    """The result of `verify`; on a board, `claimed` and `replays` are added."""

    protocol: Count | None = None  # only in old results; otherwise the log has it
    env: EnvId
    digest: Hash
    nonce: str
    episodes: Annotated[int, Field(ge=1, le=10**6)]
    policies: Annotated[list[PolicyResult], Field(min_length=1, max_length=100)]
    robustness: dict[Text, list[Number]]
    often: list[Number | None]
    seconds: Number
    machine: dict[str, str | int | None]
    versions: dict[str, str]
    build: Hash | None = None
    claimed: Claimed | None = None
    replays: list[Replay] = Field(default_factory=list)

    @model_validator(mode="after")
    def _fit(self) -> Self:
        for policy in self.policies:
            lists = (policy.returns, policy.success, policy.settle, policy.effort, policy.reference)
            if any(values is not None and len(values) != self.episodes for values in lists):
                raise ValueError(f"each policy must have {self.episodes} episodes")
        conditions: list[list[Any]] = [*self.robustness.values(), [*self.often]]
        if any(len(means) != len(self.policies) for means in conditions):
            raise ValueError("each condition must have a mean for each policy")
        return self


def checked_result(result: Any) -> dict[str, Any]:
    """Return a valid result; raise a ValueError otherwise."""
    checked(VerificationResult, result)
    return result


def unpacked(content: bytes) -> dict[str, Any]:
    """Return the result in a file; raise a ValueError if it is not one."""
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(content)) as file:
            text = file.read(UNPACKED + 1)
    except Exception as error:  # zlib has errors of its own
        raise ValueError(f"it cannot be unpacked: {error}") from None
    if len(text) > UNPACKED:
        raise ValueError(f"it unpacks to more than {UNPACKED:,} bytes")
    return checked_result(load_json(text))


class ValueAxis(Strict):
    """An axis of a value function: a state's name, and evenly spaced nodes."""

    label: Text
    low: Number
    high: Number
    n: Annotated[int, Field(ge=2, le=1000)]


class ValueFunction(Strict):
    """A coarse value function over two entries of the state."""

    axes: Annotated[list[ValueAxis], Field(min_length=2, max_length=2)]
    values: list[list[Number]]

    @model_validator(mode="after")
    def _fit(self) -> Self:
        first, second = self.axes
        if len(self.values) != first.n or any(len(row) != second.n for row in self.values):
            raise ValueError(f"there must be {first.n} rows of {second.n} values")
        return self


def checked_value(content: bytes) -> dict[str, Any]:
    """Return the value function in a file; raise a ValueError if it is not one."""
    value = load_json(content)
    checked(ValueFunction, value)
    return value


@cache
def code_digest() -> str:
    """Return the SHA-256 of this package's code: another build may give other bits."""
    root = Path(__file__).parents[1]
    code = {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*.py")}
    return digest_of({name: content.replace(b"\r\n", b"\n") for name, content in code.items()})


# --- comparison ---------------------------------------------------------------------------------------------


class VerificationComparison(NamedTuple):
    """How two verifications of the same submission differ.

    Parameters
    ----------
    same : bool
        Whether every action, reward and end was the same, to the bit, and all means under disturbances.
    build : bool
        Whether both are of the same build on the same kind of processor, so that the bits must agree.
    difference : float
        The largest difference of a policy's mean return, relative to the distance from random to best known.
    far : list of str
        Differences beyond the tolerance, in words; empty if there are none.
    """

    same: bool
    build: bool
    difference: float
    far: list[str]


def compare_results(
    result: Mapping[str, Any], other: Mapping[str, Any], way: float, plans: bool = False
) -> VerificationComparison:
    """Compare two verifications of the same submission with the same nonce and number of episodes.

    Parameters
    ----------
    result, other : mapping
        Results of `verify`.
    way : float
        Best known mean return minus that of random actions.
    plans : bool
        Whether the policy searches for a plan in each episode, see `protocol.PLANNED`.

    Raises
    ------
    ValueError
        If they differ in submission, nonce or episodes.
    """
    for name in ("env", "digest", "nonce", "episodes"):
        if result[name] != other[name]:
            raise ValueError(f"the results differ in {name}: {result[name]!r} and {other[name]!r}")
    pairs = list(zip(result["policies"], other["policies"], strict=True))
    if any(a["seed"] != b["seed"] for a, b in pairs):
        raise ValueError("the results differ in the policies' seeds")
    far = []
    difference = max(abs(np.mean(a["returns"]) - np.mean(b["returns"])) for a, b in pairs) / way
    if difference > protocol.TOLERANCE:
        far.append(f"mean returns by {difference:.1e} of the scale")
    for a, b in pairs:
        for name, share in apart(a, b, way, plans).items():
            if share > protocol.APART:
                far.append(f"the {name} of {share:.1%} of the episodes of seed {a['seed']}")
    # One episode in a hundred may differ altogether.
    tolerance = protocol.PLANNED if plans else protocol.TOLERANCE
    few = tolerance * max(1.0, result["episodes"] / protocol.DISTURBED_EPISODES)
    conditions = {**result["robustness"], "acting often": result["often"]}
    others = {**other["robustness"], "acting often": other["often"]}
    if set(conditions) != set(others):
        raise ValueError("the results differ in their conditions")
    for name, means in conditions.items():
        if not _close(means, others[name], few * way).all():
            far.append(f"the means under {ascii_text(name)}")
    same = all(a["trajectory"] == b["trajectory"] for a, b in pairs)
    same = same and all(result[name] == other[name] for name in ("robustness", "often"))
    builds = [
        (r.get("build"), r["versions"], r["machine"].get("processor"), r["machine"].get("target"))
        for r in (result, other)
    ]
    of_one = result.get("build") is not None and builds[0] == builds[1]
    if of_one and not same:
        far.append("the bits, though both are of the same build")
    return VerificationComparison(same, of_one, float(difference), far)


def apart(
    policy: Mapping[str, Any], other: Mapping[str, Any], way: float, plans: bool = False
) -> dict[str, float]:
    """Return the share of episodes that differ in their returns, success, times and efforts.

    A planner may find another plan, equally good, with another time and effort. So only its means are
    compared, and the share is 0 or 1.
    """
    tolerance = protocol.PLANNED if plans else protocol.TOLERANCE

    def share(name: str, most: float) -> float:
        a, b = policy.get(name), other.get(name)
        if a is None or b is None:  # an environment without a reference
            return float(a is not b)
        return float(np.mean(~_close(a, b, most)))

    def taken(name: str, most: float) -> float:
        if not plans:
            return share(name, most)
        pairs = zip(policy[name], other[name], strict=True)
        differences = [x - y for x, y in pairs if x is not None and y is not None]
        # Of few episodes, one may differ altogether.
        most *= max(1.0, protocol.DISTURBED_EPISODES / max(1, len(differences)))
        return float(bool(differences) and abs(np.mean(differences)) > most)

    return {
        "returns": share("returns", tolerance * way),
        "reference's returns": share("reference", protocol.TOLERANCE * way),
        "successes": share("success", 0.0),
        "times": taken("settle", 0.1),
        "efforts": taken("effort", tolerance),
    }


def _close(a: Sequence[Any], b: Sequence[Any], most: float) -> Any:
    x, y = (np.array([np.inf if v is None else v for v in values], np.float64) for values in (a, b))
    with np.errstate(invalid="ignore"):
        return (x == y) | (np.abs(x - y) <= most)
