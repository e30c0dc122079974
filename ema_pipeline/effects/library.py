"""The library of effects: every module of this package that defines ``EFFECT``, and the user's own files."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import pkgutil
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

import ema_pipeline.effects as package
from ema_pipeline.effects import out_of_tolerance
from ema_pipeline.effects.base import Effect, PlacedEffect
from ema_pipeline.effects.checks import check_definition, check_on_rig, line_of_error, named_otherwise
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.rigs.types import Rig

Library = Mapping[str, Effect]


@cache
def shipped_effects() -> dict[str, Effect]:
    """Effects that ship with the product, by id."""
    found = {}
    for module in pkgutil.iter_modules(package.__path__):
        effect = getattr(importlib.import_module(f"{package.__name__}.{module.name}"), "EFFECT", None)
        if isinstance(effect, Effect):
            found[effect.id] = effect
    return found


def load_effect_file(path: str | Path) -> Effect:
    """The effect of the user's own Python file, which defines ``EFFECT = Effect(...)``.

    Raises
    ------
    EmaError
        If the file is missing, does not run or has no ``EFFECT``.
    """
    path = Path(path)
    if not path.is_file():
        raise EmaError(f"{path}: no such effect file")
    digest = hashlib.sha1(str(path.resolve()).encode()).hexdigest()[:8]
    spec = importlib.util.spec_from_file_location(f"ema_user_effect_{path.stem}_{digest}", path)
    if spec is None or spec.loader is None:
        raise EmaError(f"{path}: is no Python file; an effect file ends in .py")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # whatever a user's file raises is shown as one line
        line = line_of_error(error, path)
        where = f"{path}, line {line}" if line else f"{path}"
        said = error.msg if isinstance(error, SyntaxError) else str(error)
        raise EmaError(f"{where}: does not run: {type(error).__name__}: {said}") from None
    effect = getattr(module, "EFFECT", None)
    if isinstance(effect, Effect):
        check_definition(effect, path)
        return effect
    other = named_otherwise(path)
    if other is not None:
        raise EmaError(f"{path}, line {other[0]}: the effect is called {other[1]}; call it EFFECT")
    raise EmaError(
        f"{path}: defines no EFFECT; add EFFECT = Effect(...), see 'Adding an effect' in the documentation"
    )


def effect_library(files: Iterable[str | Path] = (), rig: Rig | None = None) -> dict[str, Effect]:
    """Shipped effects and those of the user's files; an id may not be taken twice.

    Parameters
    ----------
    files : iterable of str or Path
    rig : Rig, optional
        What the user's effects are tried on.

    Raises
    ------
    EmaError
        For a file that is not right, with line and remedy.
    """
    library = dict(shipped_effects())
    for file in files:
        effect = load_effect_file(file)
        if effect.id in library:
            raise EmaError(f"{file}: effect id '{effect.id}' is already taken; choose another id")
        if rig is not None:
            check_on_rig(effect, rig, Path(file))
        library[effect.id] = effect
    return library


def get_effect(effect_id: str, library: Library | None = None) -> Effect:
    """The effect of that id; EmaError with a hint for unknown ones."""
    known = shipped_effects() if library is None else library
    if effect_id not in known:
        raise EmaError(f"no effect '{effect_id}'{did_you_mean(effect_id, known)}")
    return known[effect_id]


def depends_on_level(label: str, library: Library | None = None) -> bool:
    """True for an effect ``id@place``, or a parameter of it, whose answer is not in proportion to the force."""
    effect = (shipped_effects() if library is None else library).get(label.partition("@")[0])
    return effect is not None and not effect.linear


def parse_sized(text: str) -> tuple[str, dict[str, float]]:
    """Read ``id@place:name=value,name=value``; without values the effect's start values apply later.

    >>> parse_sized("flexible_support@ring:mass=3,stiffness=2e7")
    ('flexible_support@ring', {'mass': 3.0, 'stiffness': 20000000.0})
    """
    label, _, sizes = text.strip().partition(":")
    values: dict[str, float] = {}
    for part in filter(None, (p.strip() for p in sizes.split(","))):
        name, equals, number = part.partition("=")
        if name.strip() in values:
            raise EmaError(f"'{text}': '{name.strip()}' is given twice; give it once")
        try:
            values[name.strip()] = float(number)
        except ValueError:
            equals = ""
        if not equals:
            raise EmaError(f"'{text}': '{part}' is not of the form name=number") from None
    return label.strip(), values


def parse_effect(
    text: str, rig: Rig, configuration: str | None = None, library: Library | None = None
) -> PlacedEffect:
    """Read ``id@place`` and check that the rig has the place.

    Parameters
    ----------
    text : str
        E.g. ``"mesh_stiffness_loss@sun-planet1"``.
    rig : Rig
    configuration : str, optional
        Where the place must exist; in any of the rig's configurations where left out.
    library : dict of str to Effect, optional
        The shipped effects where left out.

    Raises
    ------
    EmaError
        For a wrong form, an unknown effect or a place that the rig does not have.
    """
    effect_id, at, place = text.strip().partition("@")
    if not at or not effect_id or not place:
        raise EmaError(f"'{text}' is not of the form effect@place, e.g. 'sensor_mass@all'")
    place = place.strip()
    if effect_id.strip() == out_of_tolerance.ID:
        return out_of_tolerance.tolerance_effect(rig, place)
    effect = get_effect(effect_id.strip(), library)
    configurations = rig.configurations if configuration is None else (configuration,)
    assemblies = [rig.assembly(c) for c in configurations]
    effect = next((e for a in assemblies if (e := effect.at(a, place)) is not effect), effect)
    if not any(effect.fits(a, place) for a in assemblies):
        known = dict.fromkeys(p for a in assemblies for p in effect.find_places(a))
        where = f" in configuration '{configuration}'" if configuration is not None else ""
        hint = did_you_mean(place, known) if known else "; the rig has no place for this effect"
        raise EmaError(f"effect '{effect.id}' cannot sit at '{place}' of rig '{rig.name}'{where}{hint}")
    return PlacedEffect(effect, place)
