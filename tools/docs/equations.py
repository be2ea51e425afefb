"""A scene's formulas as LaTeX, derived by SymPy from its Lagrangian, and LaTeX as MathML.

Browsers draw MathML themselves, so pages need neither script nor font for formulas.
"""

from __future__ import annotations

import re
from html import escape
from typing import Any

import sympy
from latex2mathml.converter import convert
from sympy.simplify.fu import TR10i

from lag_envs.mechanics.recording import parameter_names
from lag_envs.scenes import Scene, symbolic
from lag_envs.scenes.derivation import layout_of
from lag_envs.scenes.html import LOW, wrapped_mathml
from tools.docs.markdown import groups, parameter_descriptions

#: A single letter, the symbol that a docstring gives a parameter, as in "Mass m of the bar."
LETTER = re.compile(r"(?<![\w'/=])[A-Zb-zα-ωΑ-Ω](?![\w'/(=²])")


def symbol(scene: type[Scene], name: str) -> str:
    r"""Return a parameter's symbol in LaTeX: the letter in its description, or its name.

    Examples
    --------
    >>> from lag_envs.scenes import Acrobot, PivotedBar
    >>> symbol(PivotedBar, "com_distance"), symbol(Acrobot, "mass_1")
    ('L', 'm_{1}')
    """
    found = LETTER.search(parameter_descriptions(scene).get(name, ""))
    if not found:
        return _word(name)
    together = [one.split("_") for one in groups(scene)[name]]
    own = [part for part in name.split("_") if not all(part in parts for parts in together)]
    letter = sympy.latex(sympy.Symbol(found[0]))
    return f"{letter}_{{{','.join(own)}}}" if own else letter


def lagrangian_expression(scene: Scene) -> str:
    """Return T - V."""
    return rf"\mathcal{{L}} = {_latex(scene, symbolic.lagrangian(scene))}"


def lagrange_equations(scene: Scene) -> list[str]:
    """Return the equations of motion: Lagrange's, one for each free coordinate, without denominators."""
    found = []
    for name in layout_of(scene).free:
        equation = _tidied(symbolic.euler_lagrange(scene, name))
        numerator = sympy.expand(sympy.fraction(sympy.together(equation))[0])
        common = sympy.Mul(*(f for f in sympy.Mul.make_args(sympy.factor_terms(numerator)) if not f.is_Add))
        tidy = sympy.collect(sympy.expand(numerator / common), _accelerations(scene), _short)
        found.append(f"{_latex(scene, tidy)} = 0")
    return found


def with_numbers(scene: Scene) -> str:
    """Return the acceleration of the only free coordinate, with the scene's numbers inserted."""
    (name,) = layout_of(scene).free
    acceleration = sympy.Function(name, real=True)(symbolic.t).diff(symbolic.t, 2)
    equation = _tidied(symbolic.euler_lagrange(scene, name))
    numbers = {s: getattr(scene, s.name) for s in equation.free_symbols if s.name in parameter_names(scene)}
    equation = sympy.expand(equation.xreplace({s: sympy.Rational(repr(x)) for s, x in numbers.items()}))
    factor = sympy.simplify(equation.diff(acceleration))
    rest = sympy.expand(acceleration - equation / factor)
    return f"{_latex(scene, acceleration)} = {_latex(scene, rest.evalf(5))}"


def _tidied(expression: Any) -> Any:
    """Simplify by the identities that mechanics needs; `sympy.simplify` is ten times slower."""
    expression = sympy.expand(expression)
    for angle in sorted({f.args[0] for f in expression.atoms(sympy.sin, sympy.cos)}, key=str):
        sine, cosine = sympy.sin(angle), sympy.cos(angle)
        expression = sympy.expand(expression.subs(cosine**2, 1 - sine**2))
        expression = expression.subs(sine * cosine, sympy.sin(2 * angle) / 2)
    return TR10i(expression)  # sin a sin b + cos a cos b = cos(a - b), and the like


def _short(coefficient: Any) -> Any:
    return sympy.factor(sympy.simplify(coefficient)) if not coefficient.atoms(sympy.Function) else coefficient


def _accelerations(scene: Scene) -> list[Any]:
    return [sympy.Function(q, real=True)(symbolic.t).diff(symbolic.t, 2) for q in layout_of(scene).names]


def _latex(scene: Scene, expression: Any) -> str:
    """Print an expression: dots for derivatives in time, and the letters of the scene's docstring.

    The symbols' names order the factors: parameters in the order of their declaration, then the motion.
    """
    t, steps, shown = symbolic.t, [{}, {}, {}, {}], {}

    def take(step: int, what: Any, name: str, latex: str) -> None:
        steps[step][what] = symbol = sympy.Symbol(name)
        shown[symbol] = latex

    for i, name in enumerate(layout_of(scene).names):
        place, letter = sympy.Function(name, real=True)(t), sympy.latex(sympy.Symbol(name))
        head, index, rest = letter.partition("_")
        take(0, place.diff(t, 2), f"x{i}", rf"\ddot{{{head}}}{index}{rest}")
        take(1, place.diff(t), f"w{i}", rf"\dot{{{head}}}{index}{rest}")
        take(2, place, f"v{i}", letter)
    for i, name in enumerate(layout_of(scene).controls):
        take(2, sympy.Function(name, real=True)(t), f"u{i}", _word(name))
    order = {name: i for i, name in enumerate(parameter_names(scene))}
    for known in expression.free_symbols:
        if known.name in order:
            take(3, known, f"a{order[known.name]:02}", symbol(type(scene), known.name))
    for step in steps:  # derivatives before their functions
        expression = expression.xreplace(step)
    for i, angle in enumerate(sorted(expression.atoms(sympy.atan), key=str)):  # SymPy omits the brackets
        within = sympy.latex(angle.args[0], symbol_names=shown)
        shown[known := sympy.Symbol(f"y{i}")] = rf"\arctan({within})"
        expression = expression.xreplace({angle: known})
    latex = sympy.latex(expression, symbol_names=shown, fold_func_brackets=True)
    return latex.replace(r"\left", "").replace(r"\right", "")


def _word(name: str) -> str:
    return rf"\mathrm{{{name}}}".replace("_", r"\ ")


def formula_mathml(latex: str, block: bool = True) -> str:
    """Return a formula as MathML that includes its LaTeX; the lines of a block formula end before + and -."""
    parts = split_terms(latex) if block else [latex]
    bodies = [_body(part) for part in parts]
    hidden = 'data-search-exclude="" encoding="application/x-tex"'
    source = f"<annotation {hidden}>{escape(latex, quote=False)}</annotation>"
    bodies[0] = f"<semantics><mrow>{bodies[0]}</mrow>{source}</semantics>"
    if not block:
        return f'<math xmlns="http://www.w3.org/1998/Math/MathML">{bodies[0]}</math>'
    return f'<div class="equation" tabindex="0">{wrapped_mathml(bodies)}</div>'


def split_terms(latex: str) -> list[str]:
    r"""Split a formula before each + and - that is between terms and outside of brackets.

    Examples
    --------
    >>> split_terms(r"x = - a (b + c) - \frac{d + e}{2} + f = 0")
    ['x = - a (b + c) ', '- \\frac{d + e}{2} ', '+ f = 0']
    """
    parts, depth = [""], 0
    for letter in latex:
        depth += (letter in "({") - (letter in ")}")
        before = parts[-1].rstrip()
        if letter in "+-" and not depth and before and not before.endswith("="):
            parts.append("")
        parts[-1] += letter
    return parts


def _body(latex: str) -> str:
    element = convert(latex)
    (body,) = re.fullmatch(r"<math[^>]*><mrow>(.*)</mrow></math>", element, re.DOTALL).groups()  # type: ignore[union-attr]
    # Several upright letters in a row are a word.
    body = re.sub(
        r'(?:<mi mathvariant="normal">[a-z]</mi>|<mtext>&#x000A0;</mtext>){2,}',
        lambda word: "<mtext>" + re.sub(r"<[^>]+>", "", word[0]) + "</mtext>",
        body,
    )
    # A thin space around a function's name, unless a bracket or an exponent follows.
    space = '<mspace width="0.17em"></mspace>'
    body = re.sub("<mo>(max|min)</mo>", r"<mi>\1</mi>", body)
    functions = r"(?<!<ms[bu][bp]>)(<mi>(?:sin|cos|tan|arctan|log|exp|max|min)</mi>)"
    body = re.sub(rf"{functions}(?!<mo[^>]*>&#x00028;)", rf"<mrow>{space}\1{space}</mrow>", body)
    body = re.sub(rf"{functions}(?=<mo)", rf"<mrow>{space}\1</mrow>", body)
    # Bars and fractions within a line are set tight.
    body = re.sub("<mo([^>]*)>(?=(?:/|&#x0007C;|&#x0002F;)</mo>)", r'<mo\1 lspace="0" rspace="0">', body)
    # A sign after "=" or "(", where MathML would set a minus between terms.
    body = re.sub(r"((?:&#x0003D;|&#x00028;)</mo><mo)(>&#x02212;)", r'\1 form="prefix"\2', body)
    # Primes are raised by themselves.
    body = re.sub(
        r"<msup>((?:(?!<msup>).)*?<)mi(>&#x0203[23];<)/mi></msup>", r"<mrow>\1mi\2/mi></mrow>", body
    )
    return re.sub(r"<mover>.*?</mover>", rf"{LOW}\g<0></mpadded>", body)
