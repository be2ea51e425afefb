"""The order of the series: its allowed values, its effect, and the output of `lag-envs order`."""

from pathlib import Path

import numpy as np
import pytest

from lag_envs import orders
from lag_envs.cli import main
from lag_envs.envs.vector import LagrangianVectorEnv
from lag_envs.errors import UserError
from lag_envs.scenes import Chain
from lag_envs.stepping.general import stepper_of
from lag_envs.tasks import TASKS, incline
from lag_envs.tasks.cart_pole import CartPoleExact

EXAMPLE = str(Path(__file__).parents[1] / "examples" / "ball_on_beam.py")
PENDULUM = TASKS["PivotedBar-v0"]


def test_any_order_takes_the_same_steps():
    """To rounding: each of them is certified."""
    seen = {}
    for order in (8, 10, 24):
        envs = LagrangianVectorEnv(type("Other", (CartPoleExact,), {"order": order}), 5)
        assert envs.order == order
        envs.reset(seed=3)
        for i in range(15):
            envs.step(np.full(5, i % 2))
        seen[order] = envs.state
    assert not np.array_equal(seen[8], seen[24])
    for order in (8, 10):
        np.testing.assert_allclose(seen[order], seen[24], rtol=0.0, atol=1e-13)


def test_low_orders_have_code_of_their_own():
    """The fewer coordinates, the higher the order up to which it is faster."""
    for bars, largest in ((2, 12), (3, 7)):
        stepper = stepper_of(Chain(bars=bars).mechanics)
        assert stepper.code(order=largest) is not stepper.code()
        assert stepper.code(order=largest + 1) is stepper.code()


@pytest.mark.parametrize("order", [5, 25, 10.0, True, "10"])
def test_an_order_out_of_range_is_refused(order):
    with pytest.raises(ValueError, match="order must be a whole number from 6 to 24"):
        type("Other", (CartPoleExact,), {"order": order})()


def test_a_batch_tells_its_order():
    envs = LagrangianVectorEnv(CartPoleExact, 2)
    assert envs.order == CartPoleExact.order
    with pytest.raises(AttributeError):  # the code is made for this order
        envs.order = 12
    assert LagrangianVectorEnv(PENDULUM, 2).order is None


def test_a_series_with_a_flow_of_its_own_is_measured_too():
    seen = []
    times = orders.measure_orders(PENDULUM, 3, 1, advance=lambda: seen.append(1))
    assert list(times) == list(orders.ORDERS) and len(seen) == len(times)
    assert orders.lines(PENDULUM, times, 14)[-1].startswith((PENDULUM.__name__, "Write `order = "))


def test_the_best_is_the_lowest_of_the_fastest():
    assert orders.best_order({8: 2.0, 10: 1.01, 12: 1.0, 14: 1.005}) == 10
    assert orders.best_order({8: 2.0, 10: 1.1, 12: 1.0}) == 12


@pytest.mark.parametrize(
    ("now", "said"), [(16, "Write `order = 10` into"), (10, "is as fast as any"), (9, "is as fast as any")]
)
def test_advice(now, said):
    text = orders.lines(CartPoleExact, {8: 90.0, 10: 45.0, 12: 50.0, 14: 60.0, 16: 70.0}, now)
    assert said in text[-1]


@pytest.mark.slow
def test_command(capsys):
    assert main(["order", EXAMPLE, "--num-envs", "16", "--rounds", "1"]) == 0
    out = capsys.readouterr().out
    assert all(f"\n{order:5}  " in out for order in orders.ORDERS)
    assert "order" in out.splitlines()[-1]


def test_command_refuses_what_has_no_series(capsys):
    with pytest.raises(UserError, match="moves on a slope"):
        orders.measure_orders(incline.Brake)
    assert main(["order", incline.Tilt.id]) == 2
    assert "moves on a slope" in capsys.readouterr().err
