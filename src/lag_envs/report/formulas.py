"""SymPy's expressions as lists of operations, for numbers of any kind and for Taylor series of balls."""

from __future__ import annotations

from collections.abc import Sequence
from operator import mul
from typing import Any

import sympy


class OperationList:
    """Expressions as a list of operations, for numbers of any kind and for series of balls.

    Parameters
    ----------
    expressions : sequence of sympy.Expr
        The expressions to compute.
    inputs, held : sequence of sympy.Symbol
        Their variables; `held` does not change in time. All other symbols are constants, which are bound once
        per scene.
    """

    def __init__(self, expressions: Sequence[Any], inputs: Sequence[Any], held: Sequence[Any]) -> None:
        self.constants: list[Any] = []
        #: Operations with the indices of their arguments; each appends one or two values to the inputs'
        #: values.
        self.program: list[tuple[str, tuple[int, ...]]] = []
        self._place: dict[Any, int] = {x: i for i, x in enumerate((*inputs, *held))}
        self._inputs, self.size = set(self._place), len(self._place)
        #: Indices of values that do not change in time.
        self.held = set(range(len(inputs), self.size))
        shared, rest = sympy.cse([min(e, reduced(e), key=sympy.count_ops) for e in expressions])
        constant: dict[Any, Any] = {}  # a shared constant is put back into place
        for symbol, expression in shared:
            if (expression := expression.xreplace(constant)).free_symbols & self._inputs:
                self._place[symbol] = self._of(expression)
                self._inputs.add(symbol)
            else:
                constant[symbol] = expression
        self.found = [self._of(e.xreplace(constant)) for e in rest]

    def _of(self, e: Any) -> int:
        """Return the index of an expression's value, after adding the operations that compute it."""
        if e not in self._place:
            place = self._made(e)
            self._place.setdefault(e, place)
        return self._place[e]

    def _add(self, operation: str, *given: int, values: int = 1) -> int:
        taken = given[1:] if operation in ("scale", "constant") else given
        if all(place in self.held for place in taken):
            self.held |= set(range(self.size, self.size + values))
        self.program.append((operation, given))
        self.size += values
        return self.size - values

    def _constant(self, e: Any) -> int:
        self.constants.append(e)
        return len(self.constants) - 1

    def _made(self, e: Any) -> int:
        if not e.free_symbols & self._inputs:
            return self._add("constant", self._constant(e))
        if e.is_Add:
            fixed, moving = e.as_independent(*self._inputs, as_Add=True)
            parts = [self._of(part) for part in sympy.Add.make_args(moving)]
            return self._add("sum", *parts, *([self._of(fixed)] if fixed else []))
        if e.is_Mul:
            fixed, moving = e.as_independent(*self._inputs, as_Add=False)
            # Held factors come first, so that their product is a number.
            places = sorted(
                (self._of(part) for part in sympy.Mul.make_args(moving)), key=lambda p: p not in self.held
            )
            product = places[0]
            for place in places[1:]:
                product = self._add("product", product, place)
            return product if fixed == 1 else self._add("scale", self._constant(fixed), product)
        if e.is_Pow:
            base, exponent = e.args
            if exponent.is_negative:
                return self._add("inverse", self._of(1 / e))
            if not (2 * exponent).is_Integer:
                raise ValueError(f"the power {e} is neither whole nor a half")
            root = self._of(base) if exponent.is_Integer else self._add("sqrt", self._of(base))
            power = root
            for _ in range(int(exponent if exponent.is_Integer else 2 * exponent) - 1):
                power = self._add("product", power, root)
            return power
        of, name = e.args[0], e.func.__name__
        if name in ("sin", "cos"):
            place = self._add("sin_cos", self._of(of), values=2)
            self._place |= {sympy.sin(of): place, sympy.cos(of): place + 1}
            return self._place[e]
        if name == "tan":
            return self._of(sympy.sin(of) / sympy.cos(of))
        if name == "tanh":
            return self._of(1 - 2 / (sympy.exp(2 * of) + 1))
        if name == "atan":
            return self._add("atan", self._of(of), self._of(1 + of**2))
        if name in ("exp", "log"):
            return self._add(name, self._of(of))
        raise ValueError(f"{name} of {e} is not one of sin, cos, tan, exp, log, atan, tanh, sqrt")

    def numbers(self, given: Sequence, constants: Sequence, xp: Any) -> list:
        """Return the values, for numbers whose functions are in `xp`."""
        y = list(given)
        for operation, at in self.program:
            if operation == "constant":
                y.append(constants[at[0]])
            elif operation == "scale":
                y.append(constants[at[0]] * y[at[1]])
            elif operation == "sum":
                y.append(sum(y[i] for i in at))
            elif operation == "product":
                y.append(y[at[0]] * y[at[1]])
            elif operation == "inverse":
                y.append(1 / y[at[0]])
            elif operation == "sin_cos":
                y += xp.sin_cos(y[at[0]])
            else:
                y.append(getattr(xp, operation)(y[at[0]]))
        return [y[i] for i in self.found]


def reduced(expression: Any) -> Any:
    """Return an expression multiplied out, with squares of sines replaced by squares of cosines."""
    sine = sympy.Wild("sine"), sympy.Wild("n", properties=[lambda n: n.is_Integer and n > 1])
    square = sympy.sin(sine[0]) ** sine[1]

    def turned(x: Any, n: Any) -> Any:
        return (1 - sympy.cos(x) ** 2) ** (n // 2) * sympy.sin(x) ** (n % 2)

    return sympy.expand(sympy.expand(expression).replace(square, lambda **w: turned(w["sine"], w["n"])))


class FormulaSeries:
    """The values of formulas as Taylor series in time, coefficient by coefficient.

    Parameters
    ----------
    formulas : OperationList
        The expressions to compute.
    given : sequence of list of flint.arb
        Coefficients of the inputs, which the caller extends; held inputs, at the end, have one coefficient
        each.
    constants : sequence of flint.arb
        The formulas' constants.
    """

    def __init__(self, formulas: OperationList, given: Sequence[list], constants: Sequence[Any]) -> None:
        self._formulas, self._constants = formulas, constants
        self._y: list[list] = [*given, *([] for _ in range(formulas.size - len(given)))]
        self._first = len(given)
        self._slopes: dict[int, list] = {}  # j times the j-th coefficient
        #: The series of the expressions.
        self.found = [self._y[i] for i in formulas.found]

    def extend(self) -> None:
        """Compute one more coefficient of all series, once the inputs have one more."""
        y, c, held = self._y, self._constants, self._formulas.held
        out, k = self._first, len(y[0]) - 1
        for operation, at in self._formulas.program:
            new = y[out]
            if out in held and k:
                out += 1 + (operation == "sin_cos")
                continue
            x = y[at[-1]] if operation != "constant" else []
            if operation == "constant":
                new.append(c[at[0]])
            elif operation == "scale":
                new.append(c[at[0]] * x[k])
            elif operation == "sum":
                new.append(sum(y[i][k] for i in at if not k or i not in held))
            elif operation == "product":
                a = y[at[0]]
                new.append(a[0] * x[k] if at[0] in held else sum(map(mul, a, reversed(x))))
            elif operation == "inverse":
                new.append(-sum(map(mul, x[1:], reversed(new))) / x[0] if k else 1 / x[0])
            elif operation == "sqrt":
                new.append((x[k] - sum(map(mul, new[1:], new[:0:-1]))) / (2 * new[0]) if k else x[0].sqrt())
            elif operation == "sin_cos":
                slopes = self._sloping(at[0], k)
                cosines = y[out + 1]
                if k:
                    sine = sum(map(mul, slopes[1:], reversed(cosines))) / k
                    cosines.append(-sum(map(mul, slopes[1:], reversed(new))) / k)
                    new.append(sine)
                else:
                    for part, value in zip((new, cosines), x[0].sin_cos(), strict=True):
                        part.append(value)
                out += 1
            elif operation == "exp":
                slopes = self._sloping(at[0], k)
                new.append(sum(map(mul, slopes[1:], reversed(new))) / k if k else x[0].exp())
            else:  # log and atan: y' = x' / z, where z is x or 1 + x²
                z, x = y[at[-1]], y[at[0]]
                known = sum(map(mul, self._sloping(out, k - 1)[1:], z[k - 1 : 0 : -1])) if k > 1 else 0
                new.append((x[k] - known / k) / z[0] if k else getattr(x[0], operation)())
            out += 1

    def _sloping(self, place: int, last: int) -> list:
        """Return j times the j-th coefficient, for j up to the last one."""
        slopes, series = self._slopes.setdefault(place, []), self._y[place]
        slopes += [j * series[j] for j in range(len(slopes), last + 1)]
        return slopes
