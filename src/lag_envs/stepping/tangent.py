"""Derivatives of control steps, forwards and backwards: by an exact flow, or by the general series."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from lag_envs.stepping.compiling import absent_from
from lag_envs.stepping.dual import Variable, VariableFunctions, stacked, variables_of
from lag_envs.stepping.flow_code import FlowCode, flow_code
from lag_envs.stepping.general import SeriesStepper
from lag_envs.stepping.normal_forms import NormalForm


class FlowTangent:
    """Derivatives of control steps of one scene that has a normal form.

    Parameters
    ----------
    form : NormalForm
        The scene's normal form.
    parameters : mapping from str to float
        The scene's parameters.
    by : tuple of str
        Parameters with respect to which derivatives are taken, besides state and controls.

    Attributes
    ----------
    rates : mapping from str to list of float
        Derivatives of the form's constants with respect to these parameters, without rows of 0.
    """

    def __init__(self, form: NormalForm, parameters: Mapping[str, float], by: tuple[str, ...]) -> None:
        self._form, self._constants = form, form.constants(parameters)
        self.rates = form.rates(parameters, by)
        self._by_constants = np.array([*self.rates.values()]).reshape(len(self.rates), len(by))

    def jacobian(self, states: Any, controls: Any, dt: float) -> tuple[Any, int]:
        """Return the derivatives of the end states; see `SeriesTangent.jacobian`."""
        code, absent = self._code(dt)
        by = tuple(
            name
            for name, terms in self._form.terms.items()
            if any(
                t.constant in self.rates or (t.held.number is None and t.constant not in absent)
                for t in terms
            )
        )
        first = states.shape[1] + controls.shape[1]
        found = np.empty((*states.shape, first + len(self.rates)))
        numbers = (self._constants[name.removeprefix("k_")] for name in code.constants)
        jacobian = code.compile_jacobian(by, tuple(self.rates))
        refused = jacobian(states, controls, found, dt, self._form.largest_majorant(dt), *numbers)
        if not refused and not np.isfinite(found).all():
            refused = int(np.argmin(np.isfinite(found).all(axis=(1, 2)))) + 1
        if self._by_constants.shape[1]:
            found = np.concatenate([found[..., :first], found[..., first:] @ self._by_constants], axis=-1)
        return found, refused

    def vjp(self, states: Any, controls: Any, dt: float, cotangents: Any) -> tuple[Any, int]:
        """Return gradients from those of the end states; steps that are not ordinary go through `jacobian`.

        See `SeriesTangent.vjp`.
        """
        code, _ = self._code(dt)
        numbers = np.array([dt, self._form.largest_majorant(dt), *self._constants.values()])
        slopes, by_rates, ordinary = code.vjp(tuple(self.rates))(numbers, states, controls, cotangents)
        if self._by_constants.shape[1]:
            slopes = np.concatenate([slopes, by_rates @ self._by_constants], axis=1)
        (others,) = np.nonzero(ordinary[:, 0] == 0.0)
        if len(others):
            some = np.ascontiguousarray(states[others]), np.ascontiguousarray(controls[others])
            jacobian, refused = self.jacobian(*some, dt)
            if refused:
                return slopes, int(others[refused - 1]) + 1
            slopes[others] = np.einsum("ni,nij->nj", cotangents[others], jacobian)
        return slopes, 0

    def _code(self, dt: float) -> tuple[FlowCode, frozenset[str]]:
        """Return the code of a step, and the names of the constants that are zero."""
        absent = absent_from(self._constants)
        return flow_code(self._form, dt, absent), absent


class SeriesTangent:
    """Derivatives of control steps of one scene by the general series.

    Columns are computed only for variables that the equations contain: with respect to a coordinate that does
    not occur, the derivatives are those of a shift.

    Parameters
    ----------
    stepper : SeriesStepper
        The scene's stepper.
    parameters : mapping from str to float
        The scene's parameters.
    by : tuple of str
        Parameters with respect to which derivatives are taken, besides state and controls.
    order : callable
        Returns the order of the series for a control step.
    """

    rates: ClassVar[Mapping[str, Sequence[float]]] = MappingProxyType({})  # the series has no such constants

    def __init__(
        self,
        stepper: SeriesStepper,
        parameters: Mapping[str, float],
        by: tuple[str, ...],
        order: Callable[[float], int],
    ) -> None:
        from lag_envs.stepping.machine import slots_for

        record, constants, self._parameters = stepper.tangent_record(parameters, by)
        self._stepper, self._given, self._by, self._order = stepper, record.given, by, order
        self._record = record
        n = record.size
        seen = {(node.op, node.index) for node in record.nodes}
        self._still = [i for i in range(n) if ("place", i) not in seen]
        self._free = [i for i in self._still if ("velocity", i) not in seen]
        self._moving = [*(f"q{i}" for i in range(n)), *(f"v{i}" for i in range(n))]
        without = {*(f"q{i}" for i in self._still), *(f"v{i}" for i in self._free)}
        inputs = [name for name in record.given if name not in record.constants]
        used = {source for slopes in record.tangents.values() for source in slopes}
        inputs += [f"parameter_{name}" for name in by if f"parameter_{name}" in used]
        self._columns = tuple(name for name in [*self._moving, *inputs] if name not in without)
        self._first = np.zeros((2 * n, slots_for(len(self._columns))))
        for i, name in enumerate(self._moving):
            if name in self._columns:
                self._first[i, self._columns.index(name)] = 1.0
        self._constants = np.array([constants.get(name, 0.0) for name in record.given])
        self._known_linear: dict[float, tuple[Any, ...]] = {}

    def jacobian(self, states: Any, controls: Any, dt: float) -> tuple[Any, int]:
        """Return the derivatives of the end states with respect to states, controls and parameters.

        Parameters
        ----------
        states : ndarray, shape (n, n_state)
            Where the steps begin.
        controls : ndarray, shape (n, n_controls)
            The controls that are held.
        dt : float
            Length of the step [s].

        Returns
        -------
        derivatives : ndarray, shape (n, n_state, n_state + n_controls + n_parameters)
            The derivatives; None if a step was refused.
        refused : int
            The row whose step was refused, counted from 1; 0 if none was.
        """
        count, size, first = len(states), len(self._moving) // 2, len(self._given)
        xp = VariableFunctions()
        numbers = [self._parameters.get(f"p_{name}", 0.0) for name in self._by]
        y, u, p = variables_of(states, controls, np.broadcast_to(numbers, (count, len(numbers))))
        moved = {f"parameter_{name}": number for name, number in zip(self._by, p, strict=True)}
        changed = {f"p_{name}": number for name, number in zip(self._by, p, strict=True)}
        k: dict[str, Any] = {name: changed.get(name, x) for name, x in self._parameters.items()}
        before = self._stepper.prepare(xp, y, u, k) | moved
        values = np.empty((count, first + 2 * size))
        values[:, :first] = self._constants
        for i, name in enumerate([*self._given, *self._moving]):
            if name in before:
                values[:, i] = getattr(before[name], "value", before[name])
        slopes = np.repeat(self._first[None], count, axis=0)
        refused = self._advance(values, slopes.reshape(count, self._first.size), dt, self._order(dt))
        if refused:
            return None, refused

        def stack(names: Sequence[str]) -> Any:
            found = np.zeros((len(names), len(y) + len(u) + len(p), width))
            for i, name in enumerate(names):
                found[i] = getattr(before[name], "slopes", 0.0)
            return found.transpose(2, 0, 1)

        # If no rate is held, these derivatives are the same for all states.
        width = max(np.shape(getattr(x, "slopes", 0.0))[-1:] for x in before.values())[0]
        ends = slopes[..., : len(self._columns)] @ stack(self._columns)
        start = stack(self._moving)
        for i in self._still:
            ends[:, i] += start[:, i]
        for i in self._free:
            ends[:, i] += dt * start[:, size + i]
            ends[:, size + i] += start[:, size + i]
        after = [Variable(values[:, first + i], ends[:, i].T) for i in range(2 * size)]
        finished = self._stepper.finish(xp, after[:size], after[size:], y, u, dt, k)
        return stacked(finished, count), 0

    def vjp(self, states: Any, controls: Any, dt: float, cotangents: Any) -> tuple[Any, int]:
        """Return gradients with respect to states, controls and parameters from those of the end states.

        The result has the shape (n, n_state + n_controls + n_parameters); the rest is as for `jacobian`.
        """
        if self._stepper.mechanics.coupling:
            found, refused = self.jacobian(states, controls, dt)
            return (None if refused else np.einsum("ni,nij->nj", cotangents, found)), refused
        linear = self._known_linear.get(dt) or self._linear(dt)
        self._known_linear = {dt: linear}  # only the latest is kept, since a scene mostly has one dt
        seeds, size = np.ascontiguousarray(cotangents.T), states.shape[1]
        given = np.empty((size + controls.shape[1], len(states)))
        given[:size], given[size:] = states.T, controls.T  # three times as fast as np.concatenate
        found, longest = np.empty((self._width, len(states))), np.full(len(states), dt)
        self._vjp(given, seeds, found, longest, *linear, dt, self._order(dt))
        rows = np.flatnonzero(longest < dt)
        while len(rows):  # substeps were too long for the derivatives
            given_up = rows[longest[rows] == 0.0]
            # In reverse mode no substep is longer than the shortest, so there may be too many substeps. In
            # forward mode substeps grow again.
            if len(given_up):
                slopes, refused = self.jacobian(states[given_up], controls[given_up], dt)
                if refused:
                    return None, int(given_up[refused - 1]) + 1
                found[:, given_up] = np.einsum("ni,nij->jn", cotangents[given_up], slopes)
            rows = rows[longest[rows] > 0.0]
            before, parts = longest[rows], [np.ascontiguousarray(x[:, rows]) for x in (given, seeds, found)]
            shorter = before.copy()
            self._vjp(*parts, shorter, *linear, dt, self._order(dt))
            found[:, rows], longest[rows] = parts[-1], shorter
            rows = rows[shorter < before]
        return found.T, 0

    def _linear(self, dt: float) -> tuple[Any, ...]:
        """Return the constants, and derivatives of the series' start and of the end state, for `_vjp`.

        If no rate is held, all are the same for all states.
        """
        xp, layout, moving = VariableFunctions(), self._stepper.mechanics.layout, len(self._moving)
        ends, y, u, p = variables_of(
            *(
                np.zeros((1, n))
                for n in (moving, len(layout.state), len(self._stepper.arguments), len(self._by))
            )
        )
        before = self._stepper.prepare(xp, y, u, self._parameters)
        before |= {f"parameter_{name}": x for name, x in zip(self._by, p, strict=True)}

        def by_start(names: Sequence[str]) -> Any:
            found = np.zeros((len(names), moving + self._width))
            for row, name in zip(found, names, strict=True):
                if name not in self._record.constants:
                    row[:] = np.reshape(getattr(before.get(name, 0.0), "slopes", 0.0), -1)
            return found[:, moving:]

        q, v = ends[: moving // 2], ends[moving // 2 :]
        by_end = stacked(self._stepper.finish(xp, q, v, y, u, dt, self._parameters), 1)[0]
        constants = np.concatenate([self._constants, np.zeros(moving)])
        starts = by_start([*self._given, *self._moving])[:, : len(y) + len(u)]
        parts = constants, starts, by_start([*self._moving, *self._sources]), by_end
        return tuple(map(np.ascontiguousarray, parts))

    @property
    def _width(self) -> int:
        """Number of entries of state, controls and parameters together."""
        return len(self._stepper.mechanics.layout.state) + len(self._stepper.arguments) + len(self._by)

    @cached_property
    def _advance(self) -> Callable:
        from lag_envs.stepping.driver import compile_advance_tangents

        return compile_advance_tangents(self._record, self._columns)

    @cached_property
    def _sources(self) -> tuple[str, ...]:
        return tuple(name for name in self._columns if name not in self._moving)

    @cached_property
    def _vjp(self) -> Callable:
        from lag_envs.stepping.driver import compile_vjp_all

        return compile_vjp_all(self._record, self._sources)
