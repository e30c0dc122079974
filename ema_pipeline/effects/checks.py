"""Checks on a user's effect file when it is read: what is wrong, in which line, and what to do."""

from __future__ import annotations

import ast
import math
import traceback
from pathlib import Path

import numpy as np

from ema_pipeline.effects.base import Effect
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.modes import eigen_solution
from ema_pipeline.rigs.entries import LARGEST
from ema_pipeline.rigs.types import Rig

SAME = 1e-9
"""Relative difference of matrices that is rounding."""


def check_definition(effect: Effect, path: Path) -> None:
    """Check what can be checked without a rig: the id and the numbers of every parameter.

    Raises
    ------
    EmaError
        Names file, line and remedy.
    """
    line = definition_line(path)
    if not isinstance(effect.id, str) or not effect.id.isidentifier():
        raise EmaError(f"{path}, line {line}: id '{effect.id}' is no name; take letters, digits and '_'")
    names = [p.name for p in effect.parameters]
    for p in effect.parameters:
        where = f"{path}, line {_parameter_line(path, p.name) or line}: parameter '{p.name}'"
        if names.count(p.name) > 1:
            raise EmaError(f"{where} is defined twice; name them apart")
        for key in ("null", "start", "scale", "minimum", "maximum"):
            _check_number(getattr(p, key), f"{where}: {key}", bounded=key in ("start", "scale"))
        if not p.minimum <= p.start <= p.maximum:
            raise EmaError(
                f"{where}: start {p.start:g} lies outside {p.minimum:g} … {p.maximum:g}; change one of them"
            )
        if p.scale <= 0:
            raise EmaError(f"{where}: scale {p.scale:g} must be above 0: it is the size to expect")
    if all(p.start == p.null for p in effect.parameters):
        raise EmaError(
            f"{path}, line {line}: all parameters start at null; start at a clearly visible effect"
        )


def _check_number(value: object, what: str, *, bounded: bool) -> None:
    """EmaError where a value is no number, or infinite although it must not be."""
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        raise EmaError(f"{what} = {value!r} must be a number")
    if bounded and abs(value) > LARGEST:
        raise EmaError(f"{what} = {value:g} must not exceed {LARGEST:g} in size")


def check_on_rig(effect: Effect, rig: Rig, path: Path) -> None:
    """Try an effect on a rig: at null values nothing may change, at its start values it must work.

    Raises
    ------
    EmaError
        Names file, line and remedy.
    """
    for configuration in rig.configurations:
        assembly = rig.assembly(configuration)
        try:
            places = effect.find_places(assembly)
            for place in places[:1]:
                _check_at(effect, assembly, place, path)
        except EmaError:
            raise
        except (Exception, SystemExit) as error:  # whatever a user's code raises is shown as one line
            raise EmaError(_fault(error, effect, path)) from None


def _check_at(effect: Effect, assembly: Assembly, place: str, path: Path) -> None:
    null = {p.name: p.null for p in effect.parameters}
    where = f"{path}, line {_edit_line(effect, path)}: effect '{effect.id}' at {place}"
    base, same = assembly.system(), effect.edit(assembly, place, null).system()
    for name in ("mass", "stiffness", "damping"):
        a, b = np.asarray(getattr(base, name)), np.asarray(getattr(same, name))
        if a.shape != b.shape or not np.allclose(
            a, b, rtol=SAME, atol=SAME * float(np.max(np.abs(a), initial=0.0))
        ):
            stated = ", ".join(f"{k} = {v:g}" for k, v in null.items())
            raise EmaError(
                f"{where} changes the {name} although all is null ({stated}); correct null, or edit"
            )
    started = effect.edit(assembly, place, {p.name: p.start for p in effect.parameters}).system()
    for name in ("mass", "stiffness", "damping", "structural"):
        largest = float(np.max(np.abs(getattr(started, name)), initial=0.0))
        if not largest <= LARGEST:  # `not` catches NaN as well
            raise EmaError(
                f"{where} makes the {name} {largest:.3g} at its start values; keep it below {LARGEST:g}: correct "
                "edit or start"
            )
    first = effect.parameters[0]
    if started.mass.shape != base.mass.shape and first.minimum <= first.null < math.inf:
        raise EmaError(
            f"{where} adds coordinates, which cannot be where '{first.name}' is {first.null:g}; set its minimum above "
            f"that, to {first.null + first.scale / 1000:g} for instance"
        )
    try:
        eigen_solution(started)
    except EmaError as error:
        raise EmaError(f"{where}: at its start values {error}") from None


def _fault(error: BaseException, effect: Effect, path: Path) -> str:
    where = f"{path}, line {line_of_error(error, path) or _edit_line(effect, path)}: effect '{effect.id}'"
    if isinstance(error, KeyError):
        known = ", ".join(f"'{p.name}'" for p in effect.parameters) or "none"
        return f"{where} asks for {error}, its parameters are {known}; name them alike"
    return f"{where} does not work: {type(error).__name__}: {error}"


def line_of_error(error: BaseException, path: Path) -> int | None:
    """The line of a file in which an exception arose; None where it arose elsewhere."""
    if isinstance(error, SyntaxError) and _is(error.filename, path):
        return error.lineno
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if _is(f.filename, path)]
    return lines[-1] if lines else None


def definition_line(path: Path) -> int:
    """Line of ``EFFECT = …``, 1 where there is none."""
    for node in _nodes(path):
        if isinstance(node, ast.Assign) and any(
            isinstance(t, ast.Name) and t.id == "EFFECT" for t in node.targets
        ):
            return node.lineno
    return 1


def named_otherwise(path: Path) -> tuple[int, str] | None:
    """Line and name of an ``Effect(...)`` that is not called EFFECT."""
    for node in _nodes(path):
        call = getattr(node, "value", None)
        if (
            isinstance(node, ast.Assign)
            and isinstance(call, ast.Call)
            and ast.unparse(call.func).endswith("Effect")
        ):
            return node.lineno, ast.unparse(node.targets[0])
    return None


def _is(name: str | None, path: Path) -> bool:
    return name is not None and Path(name).resolve() == path.resolve()


def _parameter_line(path: Path, name: str) -> int | None:
    for node in _nodes(path):
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("EffectParameter"):
            given = [*node.args[:1], *(k.value for k in node.keywords if k.arg == "name")]
            if any(isinstance(a, ast.Constant) and a.value == name for a in given):
                return node.lineno
    return None


def _edit_line(effect: Effect, path: Path) -> int:
    code = getattr(effect.edit, "__code__", None)
    return (
        int(code.co_firstlineno)
        if code is not None and _is(code.co_filename, path)
        else definition_line(path)
    )


def _nodes(path: Path) -> list[ast.AST]:
    try:
        return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    except (SyntaxError, ValueError, OSError):
        return []
