"""The contestants: our environments in every form, Gymnasium's, the peers, and the core itself."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from functools import partial
from typing import Any

from lag_envs.benchmark.environments import as_users_make_it, own_vector, unwrapped
from lag_envs.benchmark.peak import NUMBERS, peak
from lag_envs.benchmark.peers import PEERS
from lag_envs.benchmark.rounds import CORE, THREADED, VARIED, Contestant


def contestants(
    ids: Sequence[str], sizes: Sequence[int], keywords: Sequence[str] = (), threads: int = 1
) -> list[Contestant]:
    """Return our environments, also with other keywords and several threads, and the peers."""
    rows = []
    for id in ids:
        rows += [Contestant("lag_envs", id, "made", 1, partial(as_users_make_it, id))]
        rows += [Contestant("lag_envs", id, "unwrapped", 1, partial(unwrapped, id))]
        rows += [Contestant("lag_envs", id, "vector", n, partial(own_vector, id, n)) for n in sizes]
        if threads > 1:
            shared = partial(own_vector, id, num_threads=threads)
            rows += [Contestant(THREADED, id, "vector", n, partial(shared, n)) for n in sizes]
        for text in keywords:
            given, name = keywords_of(text), f"{id}, {text}"
            rows += [Contestant(VARIED, name, "unwrapped", 1, partial(unwrapped, id, **given))]
            rows += [
                Contestant(VARIED, name, "vector", n, partial(own_vector, id, n, **given)) for n in sizes
            ]
    for id in ("CartPole-v1", "Pendulum-v1"):
        rows += [Contestant("gymnasium", id, "made", 1, partial(as_users_make_it, id))]
    rows += [Contestant(CORE, "multiply-adds", "arithmetic", NUMBERS, peak)]
    for library, id, prepare in PEERS:
        rows += [Contestant(library, id, "vector", n, partial(prepare, n)) for n in sizes]
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
