"""Lines of Python that make up the compiled functions of an environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from lag_envs.stepping.compiling import compile_function
from lag_envs.stepping.flows import section
from lag_envs.stepping.tracing import Trace


def recorded(
    formula: Callable, inputs: Sequence[Any], outputs: Sequence[str], trace: type[Trace]
) -> list[str]:
    """Record a formula; outputs that turned out constant are assigned as well."""
    lines, values = section(formula, inputs, outputs, trace)
    return lines + [f"{name} = {value}" for name, value in zip(outputs, values, strict=True) if value != name]


def draw(names: Sequence[str], step: str) -> list[str]:
    """Draw uniform numbers of a step."""
    return [f"{name} = uniform(key, {step}, np.uint64({i}))" for i, name in enumerate(names)]


def next_episode(key: str, episode: str, episode_key: str) -> list[str]:
    """Count the episode and make its key, in ``ids`` at these places."""
    return [
        f"ids[{episode}] += np.uint64(1)",
        f"key = episode_key(ids[{key}], ids[{episode}])",
        f"ids[{episode_key}] = key",
    ]


class Rows:
    """Rows of numbers in an array: row r lies at ``array[first + r * stride]``.

    Parameters
    ----------
    names : sequence of str
        All rows, in their order.
    array, first : str
        As printed.
    stride : int or str
        A number, if it is known; then indices are unsigned. (A signed one could be negative, and by NumPy's
        rules that needs a branch.)
    """

    def __init__(self, names: Sequence[str], array: str, first: str, stride: int | str) -> None:
        self.names, self._array, self._first, self._stride = list(names), array, first, stride

    def at(self, row: str) -> str:
        """Return the place of a row."""
        r, stride = self.names.index(row), self._stride
        beyond = f"np.uint64({r * stride})" if isinstance(stride, int) else f"{r} * {stride}"
        return f"{self._array}[{self._first} + {beyond}]"

    def load(self, rows: Sequence[str], names: Sequence[str] | None = None) -> list[str]:
        """Return the line that reads rows into variables, by default of their names."""
        return [f"{', '.join(names or rows)}, = read_rows({self._places(rows)})"] if rows else []

    def store(self, rows: Sequence[str], values: Sequence[str] | None = None) -> list[str]:
        """Return the line that writes values into rows, by default the variables of their names."""
        return [f"write_rows({self._places(rows)}, ({', '.join(values or rows)},))"] if rows else []

    def _places(self, rows: Sequence[str]) -> str:
        numbers = "".join(f"{self.names.index(row)}, " for row in rows)
        return f"{self._array}, {self._first}, {self._stride}, ({numbers})"


def block(head: str, body: Sequence[str]) -> list[str]:
    """Put lines under a header."""
    return [head, *indent(body)]


def indent(lines: Sequence[str], levels: int = 1) -> list[str]:
    """Indent lines."""
    return ["    " * levels + line for line in lines]


def function(
    name: str, arguments: str, body: Sequence[str], *helpers: Callable, inner: bool = False
) -> Callable:
    """Compile a function of these lines; see `compile_function`."""
    source = "\n".join([f"def {name}({arguments}):", *indent(body), ""])
    return compile_function(name, source, *helpers, inner=inner)
