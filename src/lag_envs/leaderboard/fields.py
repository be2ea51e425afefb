"""Check untrusted data with strict pydantic models; errors become one line that is safe to print."""

from __future__ import annotations

from typing import Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from lag_envs.leaderboard.names import unreadable
from lag_envs.leaderboard.protocol import Refused

#: Plainer words for pydantic's messages.
_PLAINER = {"missing": "is missing", "extra_forbidden": "is an unknown key; leave it out"}


class Strict(BaseModel):
    """Data of exactly these types, with finite numbers and no extra keys."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


def line(longest: int, least: int = 0) -> AfterValidator:
    """Require one line of readable text: no control characters, no invisible ones."""

    def check(text: str) -> str:
        if not least <= len(text) <= longest:
            raise ValueError(f"must have {f'{least} to' if least else 'at most'} {longest} characters")
        if reason := unreadable(text):
            raise ValueError(reason)
        return text

    return AfterValidator(check)


def between(low: float, high: float) -> Any:
    """Require a number from low to high."""
    return Field(ge=low, le=high)


def length_between(least: int, most: int) -> Any:
    """Require a list's length to be from least to most."""
    return Field(min_length=least, max_length=most)


def checked(kind: Any, value: Any) -> Any:
    """Return a value validated by a model or a `TypeAdapter`; otherwise raise a ValueError of one line."""
    adapter = kind if isinstance(kind, TypeAdapter) else TypeAdapter(kind)
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        place = shown_ascii(".".join(map(str, first["loc"])))[1:-1]
        if what := _PLAINER.get(first["type"]):
            raise ValueError(f"{place} {what}") from None
        rule = first["msg"].removeprefix("Value error, ")
        got = "" if ", got " in rule else f", got {shown_ascii(first['input'])}"
        raise ValueError(f"{place}: {rule}{got}".removeprefix(": ")) from None


def accepted(kind: Any, value: Any, where: str) -> Any:
    """Return the result of `checked`; raise Refused, which names the value's place, if it is invalid."""
    try:
        return checked(kind, value)
    except ValueError as error:
        raise Refused(f"{where}: {error}") from None


def shown_ascii(value: Any) -> str:
    """Return a value for a message: short, in ASCII, without anything that a terminal would act on."""
    if isinstance(value, dict | list):
        return f"a {'table' if isinstance(value, dict) else 'list'} of {len(value)}"
    text = ascii(value)
    return text if len(text) <= 80 else text[:77] + "..."


def ascii_text(text: object) -> str:
    """Return a text in ASCII, without anything that a terminal would act on."""
    return ascii(str(text))[1:-1]
