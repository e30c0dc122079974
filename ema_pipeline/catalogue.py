"""What there is to choose from: a rig's own modes, the effects that it may be missing, every setting."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from math import isfinite
from typing import Any, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from ema_pipeline.describe import checked_rig
from ema_pipeline.rigs import model_modes
from ema_pipeline.run.settings import PipelineSettings
from ema_pipeline.simulate.settings import SimulationSettings

_UNSET = "not set"


def list_model_modes(rig: str, configuration: str | None) -> dict[str, list[dict[str, Any]]]:
    """The model's own modes for one configuration, or for all of them."""
    loaded = checked_rig(rig)
    return {
        name: [
            {"frequency_hz": m.frequency_hz, "damping_ratio": m.damping_ratio, "family": m.family}
            for m in model_modes(loaded, name)
        ]
        for name in ((configuration,) if configuration else loaded.configurations)
    }


def list_parameters(rig: str) -> list[dict[str, Any]]:
    """The rig's parameters: value, relative 1 σ of it and of like parts about it, bounds; None where not stated."""
    return [
        {
            "name": p.name,
            "value": p.value,
            "unit": p.unit,
            "tolerance": None if p.free else p.tolerance,
            "scatter": p.scatter,
            "min": p.minimum,
            "max": p.maximum if isfinite(p.maximum) else None,
        }
        for p in checked_rig(rig).parameters.values()
    ]


def list_effects(rig: str, effect_files: Iterable[str] = ()) -> list[dict[str, Any]]:
    """Effects that can sit on a rig, with places, parameters and tell-tale signs; the user's own are tried on it."""
    from ema_pipeline.effects.library import effect_library

    loaded = checked_rig(rig)
    listed = []
    for effect in effect_library(effect_files, loaded).values():
        places = dict.fromkeys(p for c in loaded.configurations for p in effect.places(loaded, c))
        if places:
            parameters = [
                {"name": p.name, "unit": p.unit, "null": p.null, "description": p.description}
                for p in effect.parameters
            ]
            listed.append(
                {
                    "id": effect.id,
                    "title": effect.title,
                    "places": list(places),
                    "parameters": parameters,
                    "signs": effect.signs,
                    "reference": effect.reference,
                }
            )
    return listed


def list_settings(prefix: str = "") -> list[dict[str, Any]]:
    """Every setting of a pipeline whose dotted name starts with `prefix`: name, default, what it may be, why."""
    return [s for s in _settings(PipelineSettings, "") if s["name"].startswith(prefix)]


def list_simulation_settings() -> list[dict[str, Any]]:
    """Every setting of a simulated test, in the same way."""
    return list(_settings(SimulationSettings, ""))


def _settings(model: type[BaseModel], above: str) -> Iterator[dict[str, Any]]:
    for name, field in model.model_fields.items():
        if isinstance(field.default, BaseModel):
            yield from _settings(type(field.default), f"{above}{name}.")
            continue
        yield {
            "name": above + name,
            "default": list(field.default) if isinstance(field.default, tuple) else field.default,
            "values": _values(field),
            "description": " ".join((field.description or "").split()),
        }


def _values(field: FieldInfo) -> str:
    """Choices or types, and limits, e.g. ``"none | auto | number"`` or ``"number ≥ 0, < 1"``."""
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    limits = [
        f"{sign} {getattr(m, key):g}"
        for m in field.metadata
        for key, sign in signs.items()
        if hasattr(m, key)
    ]
    choices = list(dict.fromkeys(_choices(field.annotation)))
    unset = [_UNSET] if _UNSET in choices else []  # comes last: limits are those of the others
    stated = " | ".join(choice for choice in choices if choice != _UNSET)
    return " | ".join([f"{stated} {', '.join(limits)}".strip(), *unset])


def _choices(annotation: Any) -> Iterator[str]:
    words = {int: "whole number", float: "number", str: "text", bool: "true | false", type(None): _UNSET}
    if isinstance(annotation, str):
        yield annotation
    elif hasattr(annotation, "__metadata__"):
        yield from _choices(annotation.__origin__)
    elif get_origin(annotation) is tuple:
        yield "list"
    elif get_args(annotation):
        for part in get_args(annotation):
            yield from _choices(part)
    else:
        yield words.get(annotation, str(annotation))
