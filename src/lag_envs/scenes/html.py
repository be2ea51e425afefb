"""Scenes as HTML for notebooks: parameters, state, controls and equations."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Sequence
from html import escape
from importlib.util import find_spec
from typing import Any

from lag_envs.scenes.derivation import layout_of

#: The equations of motion are written out if the Lagrangian has at most this many operations.
LONGEST = 150
#: A name whose last part, a number or a letter, is an index; "rest_length" as a whole is a name.
SUBSCRIPT = re.compile(r"(.*[^\W\d_])(?:_?(\d+)|_([^\W\d_]))")
#: Browsers set an exponent above a letter together with its dots; with this height they ignore the dots.
HEIGHT = "0.7em"
NO_BREAK = "\N{NO-BREAK SPACE}"
LOW = f'<mpadded height="{HEIGHT}">'


def html_table(rows: Sequence[Sequence[str]], head: Sequence[str] = ()) -> str:
    """Return rows of text as a table; the text of each cell is escaped."""
    lines = [f"<tr>{''.join(f'<th>{escape(cell)}</th>' for cell in head)}</tr>"] if head else []
    lines += [f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows]
    return f"<table>{''.join(lines)}</table>"


def parameter_rows(scene: Any) -> list[tuple[str, str]]:
    """Return names and values of a scene's parameters and structural fields."""
    rows = []
    for field in dataclasses.fields(scene):
        value, unit = getattr(scene, field.name), field.metadata.get("unit", "")
        shown = f"{value:.6g} {unit}".rstrip() if isinstance(value, float) else repr(value)
        rows.append((field.name, shown))
    return rows


def scene_html(scene: Any) -> str:
    """Return a scene's HTML for a notebook."""
    state = ", ".join(
        f"{name} [{unit}]" for name, unit in zip(scene.state_names, scene.state_units, strict=True)
    )
    controls = ", ".join(
        f"{name} [{unit}]" for name, unit in zip(scene.control_names, scene.control_units, strict=True)
    )
    about = (inspect.getdoc(type(scene)) or "").partition("\n")[0]
    # A dataclass without a docstring gets its signature as its docstring.
    if about.startswith(f"{type(scene).__name__}("):
        about = ""
    rows = [("State", state), ("Controls", controls or "none")]
    return (
        f"<div><b>{escape(type(scene).__name__)}</b> {escape(about)}{html_table(rows)}"
        f"{html_table(parameter_rows(scene), ('parameter', 'value'))}{_equations(scene)}</div>"
    )


def _equations(scene: Any) -> str:
    """Return the Lagrangian and the equations of motion, or a hint at what is missing for them."""
    if find_spec("sympy") is None:
        return '<p>Its equations need SymPy: <code>pip install "lag-envs[symbolic]"</code></p>'
    import sympy

    from lag_envs.scenes import symbolic

    energy = symbolic.lagrangian(scene)
    found = ["<p>L = T − V =</p>", mathml(energy)]
    if sympy.count_ops(energy) > LONGEST:
        code = "<code>lag_envs.scenes.symbolic.equations(scene)</code>"
        return "".join([*found, f"<p>Its equations of motion are long: {code}</p>"])
    found.append("<p>Equations of motion</p>")
    q = symbolic.motion_symbols(scene)[0]
    rates = [q[name].diff(symbolic.t, 2) for name in layout_of(scene).names]
    for name in layout_of(scene).free:
        equation = sympy.expand(symbolic.euler_lagrange(scene, name))
        squares = {
            power: 1 - sympy.cos(power.base.args[0]) ** 2
            for power in equation.atoms(sympy.Pow)
            if isinstance(power.base, sympy.sin) and power.exp == 2
        }
        shorter = sympy.expand(equation.xreplace(squares))
        shortest = min(equation, shorter, key=sympy.count_ops)
        found.append(mathml(sympy.collect(shortest, rates), " = 0"))
    return "".join(found)


def mathml(expression: Any, behind: str = "") -> str:
    """Return an expression, and text after it, as MathML, which browsers show; rates have dots."""
    from xml.dom.minidom import parseString

    import sympy
    from sympy.core.function import AppliedUndef
    from sympy.printing.mathml import MathMLPresentationPrinter
    from sympy.printing.pretty.pretty_symbology import greek_unicode

    class Printer(MathMLPresentationPrinter):
        """Writes names that end in primes with dots above them, and puts subscripts below exponents."""

        def _element(self, name: str, *children: Any) -> Any:
            made = self.dom.createElement(name)
            for child in children:
                made.appendChild(self.dom.createTextNode(child) if isinstance(child, str) else child)
            return made

        def _print_Symbol(self, symbol: Any, style: str = "plain") -> Any:
            name = symbol.name.rstrip("'")
            dots = len(symbol.name) - len(name)
            short = SUBSCRIPT.fullmatch(name)
            letter, index = (short[1], short[2] or short[3]) if short else (name, "")
            written = self._element("mi", greek_unicode.get(letter, letter))
            if dots:
                mark = self._element("mo", "˙" if dots == 1 else "¨")
                written = self._element("mpadded", self._element("mover", written, mark))
                written.setAttribute("height", HEIGHT)
            digits = "mn" if index.isdigit() else "mi"
            return self._element("msub", written, self._element(digits, index)) if index else written

        # SymPy writes entities for these two, which a parser of XML does not know.
        def _print_Exp1(self, e: Any) -> Any:
            return self._element("mi", "e")

        def _print_Pi(self, e: Any) -> Any:
            return self._element("mi", "π")

        def _print_Pow(self, e: Any) -> Any:
            written = super()._print_Pow(e)
            if written.tagName == "msup" and written.firstChild.tagName == "msub":
                return self._element("msubsup", *written.firstChild.childNodes[:], written.lastChild)
            return written

    names: dict[Any, Any] = {}
    for rate in expression.atoms(sympy.Derivative):
        names[rate] = sympy.Symbol(rate.expr.func.__name__ + "'" * int(rate.derivative_count))
    expression = expression.xreplace(names)
    names = {place: sympy.Symbol(place.func.__name__) for place in expression.atoms(AppliedUndef)}
    # Products of names need a sign between them.
    expression = expression.xreplace(names)
    written: Any = parseString(Printer({"mul_symbol": "dot"}).doprint(expression)).documentElement
    parts = [""]
    for child in written.childNodes if expression.is_Add else [written]:
        if child.nodeName == "mo" and parts != [""]:
            parts.append("")
        parts[-1] += child.toxml()
    if behind:
        parts[-1] += f"<mtext>{escape(behind).replace(' ', NO_BREAK)}</mtext>"
    return f'<div style="overflow-x: auto">{wrapped_mathml(parts)}</div>'


def wrapped_mathml(parts: Sequence[str]) -> str:
    """Split a formula in MathML into formulas between which a line may end.

    Browsers do not break formulas. A part that is not the first begins with its operator.
    """
    head = '<math xmlns="http://www.w3.org/1998/Math/MathML" displaystyle="true">'
    first, *others = parts
    others = [re.sub(r"^<mo\b", '<mo form="infix"', part) for part in others]
    return "\n".join(f"{head}<mrow>{part}</mrow></math>" for part in (first, *others))
