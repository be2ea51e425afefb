"""``lag-envs leaderboard``, ``verify``, ``export`` and ``replay``: arguments are declared elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from lag_envs.commands.base import Command, needs


def _replay(function: str) -> Callable[..., Any]:
    return lambda *arguments: getattr(import_module("lag_envs.replay"), function)(*arguments)


def _leaderboard(module: str, function: str) -> Callable[[Any], Any]:
    """Return a function of the leaderboard, imported when it is called."""

    def call(given: Any) -> Any:
        needs(
            "leaderboard",
            *("confusable_homoglyphs", "jinja2", "packaging", "pebble", "pydantic", "safetensors", "scipy"),
            *("sympy", "tomli_w", "tqdm"),
        )
        return getattr(import_module(f"lag_envs.leaderboard.{module}"), function)(given)

    return call


EXPORT = Command(
    "export",
    "turn a trained model into a submission",
    """Turn models of Stable-Baselines3 into a submission to the leaderboard, which contains only data, and
check that both act alike. Loading a model runs code, so export only your own. Networks from
`python -m agents.ppo` are data already, and are used as they are.

examples:
  lag-envs export runs/PivotedBar-v0/ppo --author "A. Author" --license MIT    all seeds of a local training
  lag-envs export s0.zip s1.zip s2.zip s3.zip s4.zip --env PivotedBar-v0 --env-steps 500000 --seconds 600 \\
      --author "A. Author" --license MIT                                       models from elsewhere""",
    _leaderboard("export", "declare_export"),
    _leaderboard("export", "run_export"),
)
VERIFY = Command(
    "verify",
    "recompute the scores of a submission",
    """Check submissions to the leaderboard and recompute their scores. Nothing in them is run, and
nothing is changed.

examples:
  lag-envs verify PivotedBar-v0-PPO                  1,000 episodes of each policy
  lag-envs verify PivotedBar-v0-PPO --episodes 50    a first look
  lag-envs verify leaderboard/inbox/* --jobs 8       several in parallel
  lag-envs verify leaderboard/inbox/* --ray auto     on the machines of a Ray cluster""",
    _leaderboard("verify", "declare_verify"),
    _leaderboard("verify", "run_verify"),
)
REPLAY = Command(
    "replay",
    "recompute a drive from its link",
    """Recompute a drive, given as a link from the leaderboard's page, from its seed and keys, with
arithmetic that has the same bits on every machine, and check whether the link claims the right
return. The exit status is 0 if it does, 1 if it does not, 2 for a damaged or forged link.

examples:
  lag-envs replay 'https://example.org/board/PivotedBar-v0.html#drive=1~...'
  lag-envs replay '#drive=1~...' --file mine.py      for an environment of your own""",
    _replay("declare"),
    _replay("run"),
)
LEADERBOARD = Command(
    "leaderboard",
    "keep the leaderboard",
    """Keep a leaderboard: add submissions, recompute their scores, show and publish the ranking. A
submission is verified with a nonce that is published after the submission was added: `add` adds
it, `nonce` publishes a nonce and verifies all that wait for one. After Ctrl-C or a kill, `add`
without a folder resumes.

examples:
  lag-envs leaderboard add my-submission             add it; it waits for the next nonce
  lag-envs leaderboard nonce 5f3c...                 publish a nonce, and verify what waits for it
  lag-envs leaderboard add mine/* --nonce test-1     both at once, for a board of your own
  lag-envs leaderboard list PivotedBar-v0            the ranking, and the state of all others
  lag-envs leaderboard serve                         the page, at http://127.0.0.1:8000
  lag-envs leaderboard add --help                    more about one action""",
    _leaderboard("cli", "declare_leaderboard"),
    _leaderboard("cli", "run_leaderboard"),
)
