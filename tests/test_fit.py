"""Parameters from independent recordings: by SciPy's DOP853 on hand-written equations."""

import math
import re
import warnings
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from covering import slow
from scipy.integrate import solve_ivp
from scipy.stats import binom

from lag_envs.scenes import CartPole, Chain, Pendulum, Scene, StepRefused, parameter
from lag_envs.scenes.fitting import fit
from lag_envs.scenes.fitting.parameters import FreeParameters
from lag_envs.scenes.fitting.recordings import doubtful_rates, doubtful_units, recordings_of
from lag_envs.scenes.fitting.result import FitWarning
from lag_envs.scenes.fitting.shooting import Shooting
from tools.docs import fit as docs

DT = 0.04
ROD = {"mass": 0.7, "length": 0.6, "damping": 0.05}
CART = {"cart_mass": 0.8, "pole_mass": 0.3, "half_length": 0.4, "friction": 0.3}


def rod(y, torque, p, g=9.81):
    """Return the rates of a uniform rod hinged at its end; 0 is upright."""
    inertia = p["mass"] * p["length"] ** 2 / 3.0
    push = 0.5 * p["mass"] * g * p["length"] * math.sin(y[0])
    return y[1], (push - p["damping"] * y[1] + torque) / inertia


def cart(y, force, p, g=9.8):
    """Return the rates of Barto, Sutton and Anderson's cart, with viscous friction."""
    m, total, half = p["pole_mass"], p["cart_mass"] + p["pole_mass"], p["half_length"]
    sin, cos = math.sin(y[2]), math.cos(y[2])
    pull = (force - p["friction"] * y[1] + m * half * y[3] ** 2 * sin) / total
    turn = (g * sin - cos * pull) / (half * (4.0 / 3.0 - m * cos * cos / total))
    return y[1], pull - m * half * turn * cos / total, y[3], turn


class Bob(Scene):
    """A spherical pendulum, singular at its poles."""

    drag: float = parameter(0.1, "N m s", least=0.0)
    coordinates = {"a": "rad", "p": "rad"}

    def kinetic(self, q, v, xp):
        return 0.5 * (v.a**2 + (xp.sin(q.a) * v.p) ** 2)

    def potential(self, q, xp):
        return 9.81 * xp.cos(q.a)

    def dissipation(self, q, v, u, xp):
        return 0.5 * self.drag * v.a**2


def motion(rates, parameters, start, controls, dt=DT):
    """Return the states under held controls, shape (steps + 1, n_state)."""
    states = [np.array(start)]
    for u in controls:
        found = solve_ivp(
            lambda t, y, u=u: rates(y, u, parameters), (0.0, dt), states[-1], "DOP853", rtol=1e-12, atol=1e-12
        )
        states.append(found.y[:, -1])
    return np.array(states)


@cache
def swings(steps=100):
    """Return the rod's states under random torques, and the torques."""
    torques = np.repeat(np.random.default_rng(1).uniform(-2.0, 2.0, -(-steps // 5)), 5)[:steps]
    return motion(rod, ROD, [3.0, 0.5], torques), torques


@cache
def ride():
    """Return the cart-pole's states under random forces, and the forces."""
    forces = np.repeat(np.random.default_rng(2).uniform(-4.0, 4.0, 24), 5)
    return motion(cart, CART, [0.0, 0.0, 2.5, 0.0], forces, 0.02), forces


def noisy(states, sizes, seed):
    return states + np.random.default_rng(seed).standard_normal(states.shape) * sizes


def agrees(found, truth):
    """Return whether estimates are within four standard errors of the truth."""
    errors = [abs(found.estimates[n] - truth[n]) / found.errors[n] for n in found.estimates]
    assert max(errors) < 4.0, errors
    return True


# --- known parameters are recovered ---


@pytest.mark.slow
def test_without_noise():
    states, torques = swings()
    found = Pendulum().fit([(states, torques, DT)], ["mass", "length", "damping"])
    for name, value in ROD.items():
        assert found.estimates[name] == pytest.approx(value, rel=1e-8)
        assert getattr(found.scene, name) == found.estimates[name]


@pytest.mark.slow
@pytest.mark.parametrize("guess", [(5.0, 4.0, 1.0), (0.05, 0.1, 0.0)], ids=["large", "small"])
def test_from_far_off(guess):
    states, torques = swings()
    data = noisy(states, [0.02, 0.1], 5)
    mass, length, damping = guess
    found = Pendulum(mass=mass, length=length, damping=damping).fit([(data, torques, DT)], list(ROD))
    assert agrees(found, ROD)
    assert found.noise["theta"] == pytest.approx(0.02, rel=0.3)
    assert found.noise["theta_dot"] == pytest.approx(0.1, rel=0.3)
    assert found.warnings == ()


def test_two_coordinates_of_which_only_the_places_are_measured():
    states, forces = ride()
    data = noisy(states, 0.01, 3)
    data[:, [1, 3]] = np.nan
    data[40:45] = np.nan  # the camera has lost it
    found = CartPole().fit([(data, forces, 0.02)], list(CART))
    assert agrees(found, CART)
    assert list(found.noise) == ["x", "theta"]
    # Rates that were not measured are inferred.
    assert np.abs(found.simulated[0] - states).max(axis=0)[[1, 3]] == pytest.approx([0.0, 0.0], abs=0.2)
    assert np.isnan(found.residuals[0][:, 1]).all() and np.isnan(found.residuals[0][42]).all()


@pytest.mark.slow
@pytest.mark.parametrize("start", [[0.5, 1.0], [2.5, 0.0]], ids=["from above", "from below"])
def test_a_gyroscope_alone(start):
    states = motion(rod, ROD, start, np.zeros(100))
    data = noisy(states, 0.05, 4)
    data[:, 0] = np.nan
    found = Pendulum(mass=0.7).fit([(data, None, DT)], ["length", "damping"])
    assert agrees(found, ROD) and found.warnings == ()
    assert np.abs(np.sin(0.5 * (found.simulated[0] - states))[:, 0]).max() < 0.05


def test_an_angle_of_which_only_the_rate_is_measured_on_a_cart():
    states, forces = ride()
    data = noisy(states, 0.01, 3)
    data[:, 2] = np.nan
    found = CartPole().fit([(data, forces, 0.02)], list(CART))
    assert agrees(found, CART)


@pytest.mark.parametrize("seed", [slow(0), slow(3), slow(5), slow(13)])
def test_gyroscopes_on_two_bars(seed):
    truth = {"length": 0.6, "damping": 0.002}
    start = np.random.default_rng(seed).uniform(-3.0, 3.0, 6)
    start[:2] = 0.0
    data = noisy(Chain(bars=2, mass=0.2, **truth).simulate(start, np.zeros(199), DT / 2), 0.01, seed)
    data[:, [2, 4]] = np.nan
    found = Chain(bars=2, mass=0.2).fit([(data, None, DT / 2)], list(truth))
    assert agrees(found, truth) and found.warnings == ()


@pytest.mark.slow
def test_a_start_where_the_model_is_singular_is_not_chosen():
    truth = Bob(drag=0.2)
    data = truth.simulate([2.0, 0.0, 0.0, 2.0], 99, 0.02)
    data[:, [0, 2]] = np.nan
    found = Bob().fit([(data, None, 0.02)], ["drag"])
    assert found.estimates["drag"] == pytest.approx(0.2, rel=1e-6)


def test_several_recordings_angles_within_one_turn_and_controls_of_both_lengths():
    states, torques = swings()
    data = noisy(states, [0.02, 0.1], 6)
    wrapped = data.copy()
    wrapped[:, 0] = (data[:, 0] + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(np.diff(wrapped[:, 0])).max() > 5.0
    sampled = np.append(torques[:50], np.nan)  # the last one is not used
    half = [(wrapped[:51], sampled, DT), (data[50:], torques[50:, None], DT)]
    found = Pendulum().fit(half, list(ROD))
    assert agrees(found, ROD)
    assert [len(x) for x in found.simulated] == [51, 51]


@pytest.mark.slow
def test_few_samples_on_a_finer_grid():
    states, torques = swings()
    data = np.full((401, 2), np.nan)
    data[::4] = noisy(states, [0.02, 0.1], 10)
    found = Pendulum().fit([(data, np.repeat(torques, 4), DT / 4)], list(ROD))
    assert agrees(found, ROD) and found.warnings == ()


@pytest.mark.slow
def test_chaos():
    """A change of the start grows a million times within the recording."""
    truth = Chain(bars=2, damping=0.002)
    states = truth.simulate([0.0, 0.0, 2.0, 0.0, 2.5, 0.0], np.zeros(500), 0.02)
    growth = np.eye(6)
    for state in states[:-1]:
        growth = truth.jacobian(state, 0.0, 0.02)[0] @ growth
    assert np.abs(growth).max() > 1e6
    data = noisy(states, [0.001, 0.01, 0.01, 0.05, 0.01, 0.05], 8)
    guess = Chain(bars=2, com_distance=0.2, inertia=0.004, damping=0.01)
    names = ["com_distance", "inertia", "damping"]
    found = guess.fit([(data, None, 0.02)], names)
    assert agrees(found, {name: getattr(truth, name) for name in names})


class Rod(Scene):
    """A rod whose inertia is a uniform one's unless another is given."""

    mass: float = parameter(0.7, "kg", above=0.0)
    length: float = parameter(1.0, "m", above=0.0)
    damping: float = parameter(0.05, "N m s", least=0.0)
    inertia: float = parameter(lambda rod: rod.mass * rod.length**2 / 3.0, "kg m²", above=0.0)

    coordinates = {"theta": "rad"}
    controls = {"torque": "N m"}

    def kinetic(self, q, v, xp):
        return 0.5 * self.inertia * v.theta**2

    def potential(self, q, xp):
        return 0.5 * self.mass * 9.81 * self.length * xp.cos(q.theta)

    def dissipation(self, q, v, u, xp):
        return 0.5 * self.damping * v.theta**2

    def applied(self, q, v, u, xp):
        return {"theta": u.torque}


def test_what_follows_from_a_free_parameter_goes_on_following():
    states, torques = swings()
    data = [(noisy(states, [0.02, 0.1], 4), torques, DT)]
    found = Rod().fit(data, ["length", "damping"])
    assert agrees(found, {name: ROD[name] for name in ("length", "damping")})
    assert found.scene.inertia == pytest.approx(found.scene.mass * found.scene.length**2 / 3.0)
    same = Pendulum(mass=ROD["mass"], damping=0.05).fit(data, ["length", "damping"])
    assert found.errors == pytest.approx(same.errors, rel=1e-6)
    inertia = ROD["mass"] * ROD["length"] ** 2 / 3.0
    held = FreeParameters(Rod(inertia=inertia), ("length",))
    assert held.scene(np.log([5.0])).inertia == inertia
    given = Rod(length=ROD["length"]).fit(data, ["inertia"])
    assert agrees(given, {"inertia": inertia})


# --- intervals ---


def coverage(sets):
    """Return how often each interval contains the truth, over data sets that differ in their noise."""
    states, torques = swings(60)
    inside = dict.fromkeys(ROD, 0)
    for seed in range(sets):
        data = noisy(states, [0.05, 0.2], 1000 + seed)
        found = Pendulum(mass=1.0, damping=0.1).fit([(data, torques, DT)], list(ROD))
        for name, (low, high) in found.intervals.items():
            inside[name] += low <= ROD[name] <= high
    return inside


def test_coverage():
    lowest = binom.ppf(1e-3, 40, 0.95)
    assert all(count >= lowest for count in coverage(40).values())


@pytest.mark.slow
def test_coverage_of_many():
    low, high = binom.ppf([1e-3, 1.0 - 1e-3], 400, 0.95)
    assert all(low <= count <= high for count in coverage(400).values())


def test_level_and_known_noise():
    states, torques = swings()
    data = [(noisy(states, [0.02, 0.1], 7), torques, DT)]
    noise = {"theta": 0.02, "theta_dot": 0.1}
    rod = Pendulum(mass=ROD["mass"], damping=ROD["damping"])
    wide, narrow = (rod.fit(data, ["length"], noise=noise, level=level) for level in (0.99, 0.5))
    assert wide.noise == noise and wide.estimates == narrow.estimates
    (low, high), (inner_low, inner_high) = wide.intervals["length"], narrow.intervals["length"]
    assert low < inner_low < inner_high < high
    # Normal quantiles, in the logarithm of positive parameters.
    ratio = math.log(high / low) / math.log(inner_high / inner_low)
    assert ratio == pytest.approx(2.5758 / 0.67449, rel=1e-4)
    assert wide.errors["length"] == pytest.approx(
        0.5 * math.log(high / low) / 2.5758 * wide.estimates["length"], 1e-4
    )


# --- undetermined parameters ---


def test_undetermined_together():
    states, torques = swings()
    free = motion(rod, ROD, [2.0, 0.0], np.zeros(60))
    with pytest.raises(
        ValueError, match=r"do not determine mass and damping apart: changing mass by \+1 %, damping"
    ) as e:
        Pendulum().fit([(noisy(free, 0.01, 1), None, DT)], ["mass", "length", "damping"])
    assert "so that it is held" in str(e.value) and "The search ended at mass=" in str(e.value)
    both = [(noisy(free, 0.01, 1), None, DT), (noisy(states, 0.01, 2), torques, DT)]
    assert agrees(Pendulum().fit(both, list(ROD)), ROD)  # a recording under torques distinguishes them


def test_undetermined_alone():
    """All rods fall alike, except for the damping, which is tiny."""
    free = motion(rod, ROD | {"damping": 0.0}, [2.0, 0.0], np.zeros(40))
    message = "do not determine mass, which has no effect of its own .* Leave mass out of free, so that it is"
    with pytest.raises(ValueError, match=message):
        Pendulum(damping=1e-14).fit([(noisy(free, 0.01, 1), None, DT)], ["length", "mass"])


def test_hardly_determined():
    """A rod that falls freely reveals its mass only by its damping."""
    free = motion(rod, ROD, [3.0, 0.0], np.zeros(12))
    with pytest.warns(FitWarning, match="the data hardly determine mass"):
        found = Pendulum(damping=ROD["damping"]).fit([(noisy(free, 0.03, 2), None, DT)], ["length", "mass"])
    assert f"! {found.warnings[0]}" in str(found)
    unbounded = FreeParameters(Pendulum(), ("mass",)).values(np.array([1e4]))
    assert unbounded == math.inf  # silently: the end of an interval


@pytest.mark.slow
def test_at_rest():
    """Nothing moves, so nothing is learnt; sin(π) is rounding, and no signal."""
    still = np.tile([math.pi, 0.0], (100, 1))
    with pytest.raises(ValueError, match=r"do not determine length, .* measured\. Add recordings"):
        Pendulum(mass=0.3, length=0.8, damping=0.01).fit([(still, None, 0.02)], ["length"])
    with pytest.raises(
        ValueError, match=r"determine mass, .*; nor length, .* Add recordings in which they have"
    ):
        Pendulum().fit([(still, None, 0.02)], ["mass", "length"])


def test_a_model_that_is_wrong():
    """Its parameters run away to where they have no effect, which is not the data's fault."""
    states, torques = swings()
    for data, controls in ((-states, torques), (states, -torques)):
        with pytest.raises(ValueError, match=r"^mass=\S+ grew without bound: .* its sign, .* may be wrong$"):
            Pendulum().fit([(noisy(data, 0.01, 1), controls, DT)], list(ROD))
    with pytest.raises(
        ValueError, match=r"such as recordings under known controls.* a control, .* is wrong$"
    ):
        Pendulum().fit([(noisy(states, 0.01, 1), None, DT)], list(ROD))


def test_at_the_end_of_its_range():
    free = motion(rod, ROD | {"damping": 0.0}, [2.0, 0.0], np.zeros(60))
    for seed in range(4):  # in half of the data, noise looks like negative damping
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            found = Pendulum(mass=ROD["mass"]).fit(
                [(noisy(free, 0.01, seed), None, DT)], ["length", "damping"]
            )
        assert found.estimates["damping"] >= 0.0 and found.intervals["damping"][0] == 0.0
        if any("end of its range" in str(w.message) for w in seen):
            return
    pytest.fail("no estimate was at 0")


def test_a_model_that_does_not_follow():
    states, torques = swings()
    with pytest.warns(FitWarning) as seen:
        Pendulum(damping=0.05).fit([(noisy(states, 0.01, 1), torques, DT)], ["length"])
    texts = [str(w.message) for w in seen]
    words = r"does not follow theta: it is off by \S+ rad, where short pieces of it are off by \S+ rad; a fix"
    assert any(re.search(words, text) for text in texts)
    assert any("residuals of theta are not independent" in text for text in texts)


def test_what_was_misread():
    states, torques = swings()
    data = noisy(states, 0.01, 1)
    data[:, 1] = np.nan
    data[[30, 77], 0] += [0.5, -0.3]
    with pytest.warns(FitWarning, match="2 values of theta may be misread"):
        found = Pendulum(mass=ROD["mass"]).fit([(data, torques, DT)], ["length", "damping"])
    (text,) = found.warnings
    assert f"the largest, 0.48 rad, at {30 * DT:.4g} s. If so, give NaN there" in text
    assert "intervals do not hold" in text
    data[[30, 77], 0] = np.nan
    assert found.scene.fit([(data, torques, DT)], ["length", "damping"]).warnings == ()


def test_degrees():
    scene = Pendulum()
    angles = np.degrees(2.0 + np.cos(0.3 * np.arange(100)))
    given = [(np.stack([a, np.full(100, np.nan)], axis=1), None, 0.02) for a in (angles, np.radians(angles))]
    found = [doubtful_units(scene, recordings_of(scene, [one])) for one in given]
    told = "theta spans 18.2 turns in a recording; if it was measured in degrees, use np.radians"
    assert found == [[told], []]
    # They are told before the search, even if that fails.
    with pytest.warns(FitWarning, match="theta spans"), pytest.raises(ValueError, match="too few"):
        scene.fit([(given[0][0][:3], None, 0.02)], ["length"])


@pytest.mark.parametrize(
    ("factors", "dt", "told"),
    [
        ([1.0, 180.0 / np.pi], DT, 57.3),
        ([180.0 / np.pi, 1.0], DT, 0.01745),
        ([1.0, -1.0], DT, -1.0),
        ([1.0, 1.0], 10.0 * DT, 10.0),
        ([1.0, 1.0], DT, None),
    ],
)
def test_rates_that_do_not_belong_to_their_angles(factors, dt, told):
    """Told from what was measured alone; noise and missing values make no difference."""
    states, torques = swings()
    states = states * factors * (1.0 + 0.01 * np.random.default_rng(0).normal(size=states.shape))
    states[30:33, 0] = np.nan
    found = doubtful_rates(Pendulum(), recordings_of(Pendulum(), [(states, torques, dt)]))
    assert len(found) == bool(told)
    if told:
        (stated,) = re.findall("^theta_dot is (.*) times the rate at which theta changes", found[0])
        assert float(stated) == pytest.approx(told, rel=0.05)


def test_an_interval_in_milliseconds():
    """It is told at once; the search would take minutes."""
    states, torques = swings()
    told = r"a step of recording 0 lasts 40 s and needs \d{4} substeps, .* not in seconds, convert it"
    with pytest.warns(FitWarning, match=told), pytest.raises(ValueError, match="too few"):
        Pendulum().fit([(states[:2], torques[:1], 1e3 * DT)], list(ROD))


def test_a_search_that_takes_long_is_cut_short(monkeypatch):
    """Otherwise it would take minutes; and after one that has not converged, none takes as long again."""
    monkeypatch.setattr("lag_envs.scenes.fitting.recordings.LONG", 0)  # these steps count as long
    monkeypatch.setattr(fit, "LONGEST_SLOW", 3)
    (states, torques), searches, solve = swings(), [], Shooting.solve
    monkeypatch.setattr(Shooting, "solve", lambda *a, **k: searches.append(solve(*a, **k)) or searches[-1])
    with pytest.warns(FitWarning) as seen:
        Pendulum().fit([(noisy(states, [0.02, 0.1], 9), torques, DT)], list(ROD))
    texts = " ".join(str(w.message) for w in seen)
    assert "will take long" in texts and "ended before it converged" in texts
    counts = [search.nfev for search in searches]
    assert max(counts) == 3 and counts[-1] == 1


def test_without_bound():
    sought = FreeParameters(Pendulum(), ("length", "damping"))
    estimates, errors = {"length": 0.5, "damping": 4e6}, {"length": 0.1, "damping": 1e10}
    fitted = SimpleNamespace(estimates=estimates, errors=errors, correlation=np.eye(2))
    best = sought.scaled([0.5, 4e6]), np.array([0.2, 1e10])
    for converged, told in (
        (False, "damping=4e+06 grew without bound"),
        (True, "hardly determine damping: 4e"),
    ):
        (text,) = fit._doubts_of_parameters(fitted, sought, *best, converged)
        assert told in text
    estimates["damping"] = 1e-30  # with the same error, but at the end
    (text,) = fit._doubts_of_parameters(fitted, sought, sought.scaled([0.5, 1e-30]), best[1], True)
    assert "damping=1e-30 lies at the end of its range" in text


# --- display ---


def test_table_and_picture(tmp_path):
    states, torques = swings()
    found = Pendulum().fit([(noisy(states, [0.02, 0.1], 9), torques, DT)], list(ROD))
    head, titles, *rows = str(found).splitlines()
    assert head.startswith("Pendulum: 1 recording, 202 values; noise theta 0.0")
    assert titles.split() == ["parameter", "estimate", "std.", "error", "95", "%", "interval", "unit"]
    assert [row.split()[0] for row in rows] == list(ROD)
    figure = found.plot()
    assert [ax.get_ylabel() for ax in figure.axes[::3]] == ["theta [rad]", "theta_dot [rad/s]"]
    drawn = figure.axes[1].lines[0].get_ydata()
    assert np.array_equal(drawn, found.residuals[0][:, 0])
    figure.savefig(tmp_path / "fit.png")
    assert (tmp_path / "fit.png").stat().st_size > 10_000


# --- bad input ---


STATES = np.linspace(0.0, 1.0, 40).reshape(20, 2)


@pytest.mark.parametrize(
    ("recordings", "keywords", "message"),
    [
        ([], {}, "recordings must be a list of at least one .states, controls, dt."),
        ([(STATES, None)], {}, r"recording 0 must be \(states, controls, dt\), got a tuple of 2$"),
        ([{"states": STATES}], {}, "got a dict$"),
        (STATES, {}, r"a list of at least one \(states, controls, dt\), got an array of shape \(20, 2\)$"),
        ([(np.ma.masked_invalid(STATES), None, DT)], {}, r"got a masked array; call filled\(np.nan\)$"),
        ([([[1.0, None]] * 9, None, DT)], {}, r"a list of 9; np.array\(states, float\) makes NaN of None"),
        ([([[1.0, 2.0], [1.0]], None, DT)], {}, "got a list of 2: setting an array element with a sequence"),
        ([(STATES.astype(object), None, DT)], {}, "got an array of type object; np.array"),
        ([(STATES + 0j, None, DT)], {}, "NaN for what was not measured, got an array of type complex128$"),
        ((STATES, None, DT), {}, r"\(states, controls, dt\), got a single recording; put it into a list$"),
        ([(STATES[:, :1], None, DT)], {}, r"recording 0: states must have shape \(N, 2\), .* got \(20, 1\)"),
        ([(STATES[:1], None, DT)], {}, "at least two states, got 1"),
        ([(STATES * np.nan, None, DT)], {}, "nothing was measured"),
        ([(STATES / [1, np.inf], None, DT), (STATES + np.inf, None, DT)], {}, "recording 1: .* row 0"),
        ([(STATES, None, 0.0)], {}, "dt must be above 0 s, got 0 s"),
        ([(STATES, None, np.arange(20))], {}, "finer even grid, with NaN between"),
        ([(STATES, np.full(19, np.nan), DT)], {}, "controls must be finite, got nan in row 0"),
        ([(STATES, np.zeros(18), DT)], {}, "20 states need controls for the 19 steps .* got 18"),
        ([(STATES, np.zeros((19, 2)), DT)], {}, "controls must have shape .* for each step"),
        ([(STATES[:2], None, DT)], {}, "4 measured values are too few for 2 parameters and the 2 entries"),
        ([(STATES, None, DT)], {"free": []}, "free must name at least one"),
        ([(STATES, None, DT)], {"free": "mass"}, "free: parameters must be a sequence"),
        ([(STATES, None, DT)], {"free": ["lenght"]}, "free: Pendulum has no parameter 'lenght', only mass"),
        ([(STATES, None, DT)], {"free": ["mass", "mass"]}, "free: the parameter 'mass' is named twice"),
        ([(STATES, None, DT)], {"noise": {"angle": 1.0}}, "noise: there is no state 'angle'"),
        ([(STATES, None, DT)], {"noise": {"theta": 1.0}}, "noise lacks theta_dot"),
        ([(STATES, None, DT)], {"noise": {"theta": 0.0}}, r"noise\['theta'\] must be above 0, got 0"),
        ([(STATES, None, DT)], {"noise": 0.01}, "by its name, as in {'theta': 0.01}, got 0.01"),
        ([(STATES * [np.nan, 1], None, DT)], {"noise": 0.0}, "by its name, as in {'theta_dot': 0.01}"),
        ([(STATES, None, DT)], {"level": 95}, "level must be between 0 and 1, got 95"),
    ],
)
def test_bad_input(recordings, keywords, message):
    with pytest.raises(ValueError, match=message):
        Pendulum().fit(recordings, **{"free": ["mass", "length"]} | keywords)


def test_a_first_guess_that_cannot_be_simulated():
    with pytest.raises(StepRefused, match=r"Check the units of the data .*step 0"):
        Pendulum(gravity=1e50).fit([(STATES, None, DT)], ["length"])
    with pytest.raises(
        StepRefused, match=r"guess .*: a, not measured, was guessed to be 0 .*; measure it too"
    ):
        Bob().fit([(np.full((20, 4), [np.nan, np.nan, 0.0, 1.0]), None, DT)], ["drag"])


# --- the tutorial ---


def test_the_tutorials_recording_is_as_generated_and_its_truth_is_found():
    assert docs.RECORDING.read_text(encoding="utf-8") == docs.recording()
    found = docs.fitted()
    for name, (low, high) in found.intervals.items():
        assert low < docs.ROD[name] < high
    assert math.degrees(found.noise["theta"]) == pytest.approx(docs.NOISE, rel=0.15)


@pytest.mark.parametrize("free", [["length"], ["length", "damping"]])
def test_noise_alone_determines_nothing(free):
    for seed in range(4):
        noise = 0.02 * np.random.default_rng(seed).normal(size=100)
        states = np.column_stack([np.pi + noise, np.full(100, np.nan)])
        with pytest.warns(FitWarning) as seen:
            Pendulum(mass=0.12, length=0.7, damping=0.004).fit([(states, None, 0.04)], free=free)
        assert any("the motion hardly stands out from the noise" in str(w.message) for w in seen)
