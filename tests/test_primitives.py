"""The pieces of compiled code: the exponential, the random generator."""

import math

import mpmath
import numpy as np

from lag_envs.stepping.compiling import compile_traced
from lag_envs.stepping.primitives import episode_key, uniform


def test_exponential_to_one_ulp():
    exp = compile_traced("exponential", "x", lambda xp, x: (xp.exp(x),))
    rng = np.random.default_rng(0)
    half_ways = (np.arange(-1000, 1000) + 0.5) * math.log(2.0)
    points = [*(-rng.exponential(3.0, 3000)), *rng.uniform(-700.0, 700.0, 1000), *half_ways, 0.0]
    for x in points:
        x = min(max(float(x), -700.0), 700.0)
        exact = mpmath.exp(mpmath.mpf(x))
        assert abs(exp(x) - exact) <= math.ulp(float(exact))


def splitmix(z):
    """Return SplitMix64's output mix (variant 13), in Python's own integers."""
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) % 2**64
    return z ^ (z >> 31)


def test_random_numbers_are_the_documented_function():
    golden = 0x9E3779B97F4A7C15
    for key, episode, step, index in [(0, 1, 0, 0), (7, 3, 499, 15), (2**63 + 5, 10**6, 12345, 1)]:
        mine = splitmix((splitmix(key) + episode * golden) % 2**64)
        assert int(episode_key(np.uint64(key), np.uint64(episode))) == mine
        draw = splitmix((mine + (step * 16 + index + 1) * golden) % 2**64) >> 11
        assert uniform(np.uint64(mine), np.uint64(step), np.uint64(index)) == draw / 2**53


def test_random_numbers_are_uniform_and_uncorrelated():
    draws = np.array(
        [[uniform(np.uint64(s), np.uint64(t), np.uint64(0)) for t in range(200)] for s in range(200)]
    )
    assert abs(draws.mean() - 0.5) < 0.01
    assert abs(draws.var() - 1 / 12) < 0.003
    assert np.abs(np.corrcoef(draws)[np.triu_indices(200, 1)]).max() < 0.4
