"""Typed settings: every stage has its own class, unknown keys are refused with a hint."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError, field_validator

from ema_pipeline.errors import EmaError, did_you_mean


class Settings(BaseModel):
    """Base of all settings: immutable, unknown keys forbidden, no type taken for another (``true`` is not 1)."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, validate_default=True, allow_inf_nan=False
    )

    @field_validator("*", mode="before")
    @classmethod
    def _lists_are_tuples(cls, given: object) -> object:
        """TOML has lists only."""
        return tuple(map(cls._lists_are_tuples, given)) if isinstance(given, list) else given


def _no_boolean(given: object) -> object:
    if isinstance(given, bool):  # which equals 1
        raise ValueError("give the number 1")
    return given


FirstLayout = Annotated[Literal[1], BeforeValidator(_no_boolean)]
"""``schema = 1`` of a file."""

_ALTERNATIVE = re.compile(r"(constrained-)?(float|int|str)|\w+\[.*\]")

M = TypeVar("M", bound=BaseModel)


def parse(model: type[M], data: Any, where: str | Path) -> M:
    """Build `model` from a plain mapping; errors become one line that names file and key.

    Parameters
    ----------
    model : type
        A pydantic model class.
    data : Any
        Usually a dictionary read from TOML.
    where : str or Path
        File (and table) that the error message names.

    Raises
    ------
    EmaError
        For unknown keys, wrong types and values out of range.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first, meant = _first(error.errors())
        path, (key, name) = _path(first["loc"]), _entry(first["loc"], data)
        of = f" of '{name}'" if name else ""
        if first["type"] == "extra_forbidden":
            known = [meant] if meant else _fields_at(model, first["loc"][:-1])
            raise EmaError(
                f"{where}: unknown key '{path}'{of}{did_you_mean(str(first['loc'][-1]), known)}"
            ) from None
        if first["type"] == "missing":
            raise EmaError(f"{where}: key '{path}'{of} is missing; add it") from None
        alternatives = [e["msg"] for e in error.errors() if _path(e["loc"]) == path]
        message = " or ".join(dict.fromkeys(alternatives)).removeprefix("Value error, ")
        message = message.replace("valid tuple", "list in [ ]").replace("Tuple", "List")
        message = re.sub(r"a valid dictionary( or instance of \w+)?", "a table of keys and values", message)
        shown = _shown(first.get("input"))
        entry = f' ({key} = "{name}")' if name and key != first["loc"][-1] else ""
        raise EmaError(f"{where}: {path or 'file'} = {shown}: {message}{entry}") from None


def _first(found: Sequence[Mapping[str, Any]]) -> tuple[Mapping[str, Any], str]:
    """The error that is told, and the key that was meant where that is a misspelt one that must be there."""
    first = found[0]
    if first["type"] == "missing":
        *table, key = first["loc"]
        unknown = [e for e in found if e["type"] == "extra_forbidden" and list(e["loc"][:-1]) == table]
        for other in unknown:
            if get_close_matches(str(other["loc"][-1]), [str(key)]):
                return other, str(key)
    return first, ""


def _entry(loc: tuple[int | str, ...], data: Any) -> tuple[str, str]:
    """Of tables in a list, which are counted from 0, what names the one with the key: which of its keys, and the name.

    Both are empty where nothing does.
    """
    for step in loc[:-1]:
        try:
            data = data[step]
        except (KeyError, IndexError, TypeError):
            return "", ""
        if isinstance(step, int) and isinstance(data, dict):
            names = ((key, data[key]) for key in ("name", "file", "at") if isinstance(data.get(key), str))
            return next(names, ("", ""))
    return "", ""


def _path(loc: tuple[int | str, ...]) -> str:
    """The key; of alternatives, e.g. a word or a number, pydantic adds which of them it tried."""
    tried = bool(loc) and _ALTERNATIVE.fullmatch(str(loc[-1]))
    return ".".join(str(step) for step in (loc[:-1] if tried else loc))


def _shown(value: Any) -> str:
    """A value as TOML writes it, cut to what a line can hold."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dt.date | dt.time):
        return value.isoformat()
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= 60 else text[:57] + "..."


def setting_names(model: type[BaseModel], prefix: str = "") -> tuple[str, ...]:
    """Every setting with its tables in front, e.g. ``"modal.identify.low_hz"``."""
    names: list[str] = []
    for name, field in model.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            names += setting_names(inner, f"{prefix}{name}.")
        names.append(f"{prefix}{name}")
    return tuple(names)


def _fields_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Names of the fields of the (nested) model that `loc` leads to; keys of dictionaries are passed over."""
    current: Any = model
    in_dictionary = False
    for step in loc:
        if isinstance(step, int) or in_dictionary:
            in_dictionary = False
            continue
        field = next((f for n, f in current.model_fields.items() if str(step) in (n, f.alias)), None)
        if field is None:
            return []
        in_dictionary = _is_dictionary(field.annotation)
        leaves = [t for t in _type_leaves(field.annotation) if isinstance(t, type)]
        current = next((t for t in leaves if issubclass(t, BaseModel)), None)
        if current is None:
            return []
    return [f.alias or name for name, f in current.model_fields.items()]


def _is_dictionary(annotation: Any) -> bool:
    if get_origin(annotation) is dict:
        return True
    return get_origin(annotation) is not None and any(_is_dictionary(a) for a in get_args(annotation))


def _type_leaves(annotation: Any) -> list[Any]:
    args = getattr(annotation, "__args__", None)
    if not args:
        return [annotation]
    return [leaf for a in args for leaf in _type_leaves(a)]
