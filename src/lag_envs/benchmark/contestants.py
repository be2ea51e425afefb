"""The contestants: our environments in every form, Gymnasium's, the peers, and the core itself."""

from __future__ import annotations

import ast
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from lag_envs.benchmark.environments import as_users_make_it, own_vector, unwrapped
from lag_envs.benchmark.peak import NUMBERS, peak
from lag_envs.benchmark.peers import PEERS
from lag_envs.benchmark.rounds import CORE, THREADED, VARIED, Contestant, Run


def contestants(
    ids: Sequence[str], sizes: Sequence[int], keywords: Sequence[str] = (), threads: int = 1
) -> list[Contestant]:
    """Return our environments, also with other keywords and with several threads, and the peers."""

    def batches(library: str, name: str, prepare: Callable[[int], Run]) -> list[Contestant]:
        return [Contestant(library, name, "vector", n, partial(prepare, n)) for n in sizes]

    rows = []
    for id in ids:
        rows += [Contestant("lag_envs", id, "made", 1, partial(as_users_make_it, id))]
        rows += [Contestant("lag_envs", id, "unwrapped", 1, partial(unwrapped, id))]
        rows += batches("lag_envs", id, partial(own_vector, id))
        if threads > 1:
            rows += batches(THREADED, id, partial(own_vector, id, num_threads=threads))
        for text in keywords:
            given, name = keywords_of(text), f"{id}, {text}"
            rows += [Contestant(VARIED, name, "unwrapped", 1, partial(unwrapped, id, **given))]
            rows += batches(VARIED, name, partial(own_vector, id, **given))
    for id in ("CartPole-v1", "Pendulum-v1"):
        rows += [Contestant("gymnasium", id, "made", 1, partial(as_users_make_it, id))]
    rows += [Contestant(CORE, "multiply-adds", "arithmetic", NUMBERS, peak)]
    for library, id, prepare in PEERS:
        rows += batches(library, id, prepare)
    return rows


def keywords_of(text: str) -> dict[str, Any]:
    """Return keywords written as in a call, or raise a ValueError.

    Examples
    --------
    >>> keywords_of("observation_noise=0.01, push=(2, 0.5)")
    {'observation_noise': 0.01, 'push': (2, 0.5)}
    """
    try:
        call = ast.parse(f"_({text})", mode="eval").body
        if not isinstance(call, ast.Call) or call.args or not all(k.arg for k in call.keywords):
            raise SyntaxError
        return {str(k.arg): ast.literal_eval(k.value) for k in call.keywords}
    except (SyntaxError, ValueError):
        raise ValueError(
            f"keywords must be as in a call, such as 'observation_noise=0.01, push=(2, 0.5)', got {text!r}"
        ) from None
