"""Terms as functions of effects' sizes, against the rig assembled anew at every size."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np
import pytest

from ema_pipeline.effects.base import Effect, EffectParameter, PlacedEffect
from ema_pipeline.effects.library import parse_effect
from ema_pipeline.mechanics.assembly import Assembly, Element, Spring
from ema_pipeline.observations.effect_terms import EffectTerms
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.rigs import load_rig
from ema_pipeline.rigs.types import Rig


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("planetary")


def _model(rig: Rig, labels: list[str]) -> RigModel:
    return RigModel(rig, [parse_effect(label, rig) for label in labels])


def _assembled_anew(rig: Rig, effects: tuple[PlacedEffect, ...]) -> RigModel:
    model = RigModel(rig, effects)
    model._of_effects = dict.fromkeys(rig.configurations)
    return model


def _assert_same_matrices(model: RigModel, rig: Rig, x: np.ndarray) -> None:
    whole = _assembled_anew(rig, model.effects)
    for configuration in rig.configurations:
        found, other = model.matrices(configuration, x), whole.matrices(configuration, x)
        for kind in range(4):
            size = np.max(np.abs(other.dense[kind]), initial=1e-300)
            np.testing.assert_allclose(found.dense[kind], other.dense[kind], atol=1e-10 * size)
        np.testing.assert_allclose(found.skew, other.skew, atol=1e-9)
        for own, its in zip(found.by_shape, other.by_shape, strict=True):
            np.testing.assert_allclose(own, its, atol=1e-6 * np.max(np.abs(its), initial=1e-300))
        np.testing.assert_allclose(found.skew_by_shape, other.skew_by_shape, atol=1e-6)


@pytest.mark.parametrize(
    "labels",
    [
        [],
        ["bearing_anisotropy@sun"],
        ["bearing_anisotropy@sun", "hysteretic_damping@ring", "local_damper@carrier"],
        ["mesh_stiffness_loss@sun-planet1", "bearing_anisotropy@carrier", "bearing_anisotropy@sun"],
        ["flexible_support@ring", "bearing_anisotropy@sun"],
        ["gyroscopic@planet1", "bearing_anisotropy@ring", "planet_bearing_mistune@planet1"],
        ["sensor_mass@ring", "bearing_anisotropy@ring"],
    ],
)
def test_matrices_and_their_derivatives_are_those_of_the_rig_assembled_anew(
    rig: Rig, labels: list[str]
) -> None:
    model = _model(rig, labels)
    rng = np.random.default_rng(5)
    for _ in range(3):
        x = model.unknowns.clipped(model.start() + 0.3 * rng.standard_normal(len(model.unknowns)))
        _assert_same_matrices(model, rig, x)


def test_only_elements_whose_rows_turn_are_made_anew(rig: Rig) -> None:
    model = _model(rig, ["hysteretic_damping@ring", "bearing_anisotropy@sun", "local_damper@carrier"])
    terms = model._effect_terms("no_ring")
    assert isinstance(terms, EffectTerms)
    assert [one.effect.label for one, _ in terms.added] == ["bearing_anisotropy@sun"]
    assert list(terms.places) == [0, 3]
    assert [(place.start, place.stop) for _, place in terms.added] == [(1, 3)]


def _effect(name: str, edit: Callable[[Assembly, str, Mapping[str, float]], Assembly]) -> Effect:
    """An effect of one size at the sun."""
    return Effect(
        id=name,
        title=name,
        parameters=(EffectParameter("size", "1", 0.0, 0.1, 1.0, -3.0, 3.0, "its size"),),
        find_places=lambda assembly: ("sun",),
        edit=edit,
        signs="none",
    )


def _stiffer(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    def change(element: Element) -> Element:
        assert isinstance(element, Spring)
        return dataclasses.replace(element, stiffness=element.stiffness * (1 + values["size"]))

    return assembly.edit([f"{place} bearing x"], change)


def test_effects_that_multiply_each_other_are_assembled(rig: Rig) -> None:
    """The stiff axis is a share of a bearing that another effect changes."""
    stiffer = PlacedEffect(_effect("stiffer", _stiffer), "sun")
    model = RigModel(rig, [stiffer, parse_effect("bearing_anisotropy@sun", rig)])
    assert model._effect_terms("no_ring") is None
    _assert_same_matrices(model, rig, model.start())


def _turned(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    """Adds a turned spring, and from some size on changes a bearing as well."""
    turn = values["size"]
    spring = Spring("turned", {f"{place}.x": float(np.cos(turn)), f"{place}.y": float(np.sin(turn))}, 1e5)
    return (assembly if turn < 0.5 else _stiffer(assembly, place, {"size": -0.5})).add(spring)


def test_an_effect_that_does_more_at_other_sizes_is_assembled_there(rig: Rig) -> None:
    effect = _effect("turned", _turned)
    model = RigModel(rig, [PlacedEffect(effect, "sun")])
    assert model._effect_terms("no_ring") is not None
    for turn in (0.3, 0.8):
        x = model.start()
        x[-1] = turn
        _assert_same_matrices(model, rig, x)
