"""Effects: absent at null, present as their physics says, and open to the user's own."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from ema_pipeline.effects.base import Effect, effect_of
from ema_pipeline.effects.generic import usual_stiffness
from ema_pipeline.effects.library import (
    effect_library,
    get_effect,
    load_effect_file,
    parse_effect,
    parse_sized,
    shipped_effects,
)
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly, Mass, Spring
from ema_pipeline.mechanics.modes import complex_modes, normal_modes
from ema_pipeline.rigs import load_rig, model_modes
from ema_pipeline.rigs.frame import frame
from ema_pipeline.rigs.planetary import planetary

RIG = load_rig("planetary")
LINEAR = [e.id for e in shipped_effects().values() if e.linear]

CONTRACT_PLACES = {
    "mesh_stiffness_loss": {"sun-planet1", "sun-planet2", "ring-planet1", "ring-planet2"},
    "planet_bearing_mistune": {"planet1", "planet2"},
    "planet_mass_mistune": {"planet1", "planet2"},
    "bearing_anisotropy": {"carrier", "ring", "sun"},
    "shaft_torsion": {"carrier", "sun"},
    "shaft_coupling": {"carrier-ring", "carrier-sun", "ring-sun"},
    "sensor_mass": {"carrier", "ring", "sun", "planet1", "planet2", "all"},
    "flexible_support": {"carrier", "ring", "sun"},
    "local_damper": {"carrier", "ring", "sun", "planet1", "planet2"},
    "hysteretic_damping": {"sun-planet", "ring-planet", "carrier", "ring", "sun", "planet"},
    "gyroscopic": {"carrier", "sun", "planet1", "planet2"},
    "bearing_cubic": {"carrier", "ring", "sun"},
    "dry_friction": {"carrier", "ring", "sun"},
    "mesh_backlash": {"sun-planet1", "sun-planet2", "ring-planet1", "ring-planet2"},
}


def matrices(system) -> list[np.ndarray]:
    return [system.mass, system.stiffness, system.damping, system.structural]


def system_with(label: str, configuration: str = "with_ring", rig=RIG, **values: float):
    return rig_with_effects(rig, [(label, values)]).system(configuration)


@pytest.mark.parametrize("effect_id", LINEAR)
def test_effect_at_its_null_leaves_every_matrix_as_it_was(effect_id: str) -> None:
    effect = get_effect(effect_id)
    for configuration in RIG.configurations:
        base = RIG.assembly(configuration)
        for place in effect.places(RIG, configuration):
            edited = effect.apply(base, place).system()
            for before, after in zip(matrices(base.system()), matrices(edited), strict=True):
                np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize("effect_id", LINEAR)
def test_effect_at_its_start_value_changes_the_modes_visibly(effect_id: str) -> None:
    effect = get_effect(effect_id)
    start = {p.name: p.start for p in effect.parameters}
    base = RIG.assembly("with_ring")
    poles = complex_modes(base.system()).poles
    for place in effect.places(RIG, "with_ring"):
        edited = complex_modes(effect.apply(base, place, start).system()).poles
        moved = (
            len(edited) != len(poles) or np.max(np.abs(edited - poles) / np.maximum(np.abs(poles), 1)) > 1e-4
        )
        assert moved, place


NONLINEAR = [e.id for e in shipped_effects().values() if not e.linear]


@pytest.mark.parametrize("effect_id", NONLINEAR)
def test_nonlinear_effect_is_absent_at_its_null_and_acts_at_its_start_value(effect_id: str) -> None:
    effect = get_effect(effect_id)
    rig = load_rig("isolator") if effect.find_places(load_rig("isolator").assembly("default")) else RIG
    base = rig.assembly(rig.configurations[-1])
    places = effect.find_places(base)
    assert places
    for place in places:
        assert effect.apply(base, place).nonlinear == ()
        start = {p.name: p.start for p in effect.parameters}
        assert effect.apply(base, place, start).nonlinear


@pytest.mark.parametrize(("effect_id", "places"), CONTRACT_PLACES.items())
def test_effect_sits_at_the_places_that_are_documented(effect_id: str, places: set[str]) -> None:
    assert set(get_effect(effect_id).places(RIG, "with_ring")) == places
    assert not any("ring" in p for p in get_effect(effect_id).places(RIG, "no_ring"))


def test_every_effect_says_how_it_shows_and_starts_within_its_range() -> None:
    for effect_id in shipped_effects():
        effect = get_effect(effect_id)
        assert effect.id == effect_id
        assert len(effect.signs) > 10
        assert len(effect.title) > 10
        for p in effect.parameters:
            assert p.minimum <= p.start <= p.maximum
            assert p.scale > 0
            assert p.unit


def test_lost_mesh_stiffness_is_taken_from_one_mesh_only() -> None:
    before, after = (
        RIG.system("no_ring"),
        system_with("mesh_stiffness_loss@sun-planet2", "no_ring", fraction=0.4),
    )
    lost = before.stiffness - after.stiffness
    assert np.linalg.matrix_rank(lost, tol=1.0) == 1
    assert lost[before.dofs.index("sun.u"), before.dofs.index("sun.u")] == pytest.approx(0.4e7)
    assert lost[before.dofs.index("planet1.u"), before.dofs.index("planet1.u")] == pytest.approx(
        0.0, abs=1e-3
    )


def test_anisotropic_bearing_splits_a_body_along_its_axis() -> None:
    system = system_with("bearing_anisotropy@sun", relative_stiffness=0.2, angle_deg=90.0)
    i, j = system.dofs.index("sun.x"), system.dofs.index("sun.y")
    difference = system.stiffness[j, j] - system.stiffness[i, i]
    base = RIG.system("with_ring")
    own = base.stiffness[j, j] - base.stiffness[i, i]
    assert difference - own == pytest.approx(0.2 * 1.025e6)


def test_shaft_torsion_lifts_the_rigid_body_mode_of_the_free_carrier() -> None:
    before = [m.frequency_hz for m in model_modes(RIG, "no_ring")]
    rig = rig_with_effects(RIG, [("shaft_torsion@carrier", {"stiffness": 4e5})])
    after = [m.frequency_hz for m in model_modes(rig, "no_ring")]
    assert before.count(0.0) - after.count(0.0) == 1


def chain_of(*stiffness: float) -> Assembly:
    """Masses of 1, 2, … kg along x, in a row between springs, of which those of 0 N/m are left out."""
    count = len(stiffness) - 1
    dofs = [f"m{i + 1}.x" for i in range(count)]
    rows: list[dict[str, float]] = [
        {dofs[0]: 1.0},
        *({a: -1.0, b: 1.0} for a, b in pairwise(dofs)),
        {dofs[-1]: 1.0},
    ]
    springs = [Spring(f"k{i}", row, k) for i, (row, k) in enumerate(zip(rows, stiffness, strict=True)) if k]
    masses = [Mass(f"m{i + 1}", {d: 1.0}, i + 1.0) for i, d in enumerate(dofs)]
    return Assembly(tuple(dofs), (*masses, *springs))


def test_a_suspension_adds_as_much_to_the_square_of_every_frequency() -> None:
    """It is shared by the bodies as their masses are, so that no shape changes."""
    free, effect = chain_of(0.0, 2e5, 3e5, 0.0), get_effect("suspension")
    assert effect.find_places(free) == ("all",)
    before, after = (
        normal_modes(a.system())[0] for a in (free, effect.apply(free, "all", {"stiffness": 6e3}))
    )
    assert after[0] == pytest.approx(np.sqrt(6e3 / 6.0) / (2 * np.pi))
    assert np.diff([before**2, after**2], axis=0)[0] == pytest.approx(6e3 / 6.0 / (2 * np.pi) ** 2)
    assert effect.scales(free, "all")["stiffness"] == pytest.approx(6.0 * (2 * np.pi * 8.0) ** 2)


@pytest.mark.parametrize("springs", [(1e3, 2e5, 0.0), (1e-3, 2e5, 0.0), (0.0, 2e5, 3e5)])
def test_what_is_held_has_no_suspension_to_be_found(springs: tuple[float, ...]) -> None:
    held, effect = chain_of(*springs), get_effect("suspension")
    assert effect.find_places(held) == ()
    assert effect.fits(held, "all")  # a spring to ground that was found first does not take it away
    assert not get_effect("suspension").places(RIG, "no_ring")


def test_friction_is_sought_at_bodies_and_where_a_spring_joins_two() -> None:
    chain, effect = chain_of(1e5, 2e5, 3e5, 0.0), get_effect("dry_friction")
    assert effect.find_places(chain) == ("m1", "m2", "m3", "m1-m2", "m2-m3", "m1.x", "m2.x", "m3.x")
    assert effect.fits(chain, "m1-m3")  # which a user may name
    assert effect.places(RIG, "no_ring") == ("carrier", "sun")


def test_a_suspension_holds_every_direction_of_a_body_and_not_its_rotation() -> None:
    dofs = ("a.x", "a.y", "a.u")
    masses = [Mass(d, {d: 1.0}, m) for d, m in zip(dofs, (4.0, 4.0, 1.0), strict=True)]
    lone = get_effect("suspension").apply(Assembly(dofs, tuple(masses)), "all", {"stiffness": 100.0})
    assert np.diag(lone.system().stiffness).tolist() == [100.0, 100.0, 0.0]
    turning = Assembly(dofs[2:], tuple(masses[2:]))
    assert not get_effect("suspension").find_places(turning)
    with pytest.raises(EmaError, match="cannot sit at 'all'"):
        get_effect("suspension").apply(turning, "all", {"stiffness": 100.0})


def test_sensor_mass_lowers_every_elastic_frequency_as_one_over_the_root_of_mass() -> None:
    tip = system_with("sensor_mass@storey1", "default", rig=frame(1), mass=0.5)
    plain = frame(1).system("default")
    ratio = normal_modes(tip)[0][0] / normal_modes(plain)[0][0]
    assert ratio == pytest.approx(np.sqrt(5.0 / 5.5), rel=1e-12)
    before, after = (
        normal_modes(RIG.system("with_ring"))[0],
        normal_modes(system_with("sensor_mass@all", mass=0.03))[0],
    )
    assert np.all(after[before > 0] < before[before > 0])


def test_flexible_support_adds_two_modes_and_tends_to_none_when_stiff() -> None:
    soft = system_with("flexible_support@ring", mass=3.0, stiffness=2e7)
    assert len(soft.dofs) == len(RIG.system("with_ring").dofs) + 2
    stiff = normal_modes(system_with("flexible_support@ring", mass=1e-3, stiffness=1e12))[0]
    base = normal_modes(RIG.system("with_ring"))[0]
    np.testing.assert_allclose(stiff[: len(base)], base, rtol=2e-5)


def test_flexible_support_is_two_masses_in_a_row_for_a_single_body() -> None:
    # Sun alone (no mesh to speak of) on its bearing on a support: closed form of a two-mass chain.
    k, m, ks, ms = 1.025e6, 2.0, 3e6, 5.0
    values = {"sun_planet_mesh_stiffness": 1e-3, "ring_planet_mesh_stiffness": 1e-3}
    rig = rig_with_effects(RIG, [("flexible_support@sun", {"mass": ms, "stiffness": ks})])
    found = normal_modes(rig.system("no_ring", values))[0]
    a, b, c = m * ms, -(m * (k + ks) + ms * k), k * ks
    for expected in np.sqrt(np.roots([a, b, c]).real) / (2 * np.pi):
        assert np.sum(np.abs(found - expected) < 1e-3) == 2


def test_local_damper_adds_its_power_and_nothing_else() -> None:
    system = system_with("local_damper@planet2", coefficient=30.0)
    velocity = np.zeros(len(system.dofs))
    velocity[[system.dofs.index("planet2.zeta"), system.dofs.index("planet2.eta")]] = 1.0, 2.0
    assert velocity @ system.damping @ velocity == pytest.approx(30.0 * 5.0)
    assert np.linalg.matrix_rank(system.damping) == 2


def test_loss_factor_of_all_springs_gives_half_of_it_in_every_mode() -> None:
    places = get_effect("hysteretic_damping").places(RIG, "with_ring")
    rig = rig_with_effects(RIG, [(f"hysteretic_damping@{p}", {"loss_factor": 0.04}) for p in places])
    modes = complex_modes(rig.system("with_ring", {"modal_damping_ratio": 0.0}))
    np.testing.assert_allclose(modes.damping_ratio[modes.frequency_hz > 0], 0.02, rtol=1e-3)


def test_loss_factor_replaces_the_viscous_damper_of_its_bearing(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text('base = "planetary"\n[parameters]\nsun_bearing_damping = 28.57\n', encoding="utf-8")
    rig = load_rig(file)
    assert np.any(rig.system("no_ring").damping)
    system = system_with("hysteretic_damping@sun", "no_ring", rig=rig, loss_factor=0.02)
    assert not np.any(system.damping)
    assert np.any(system.structural)


def test_gyroscopic_coupling_is_skew_and_turns_with_the_planet() -> None:
    system = system_with("gyroscopic@planet2", coefficient=12.0, rig=planetary(3))
    np.testing.assert_array_equal(system.damping, -system.damping.T)
    i, j = system.dofs.index("planet2.zeta"), system.dofs.index("planet2.eta")
    assert system.damping[i, j] == pytest.approx(12.0)  # a rotation leaves skew coupling as it is


def test_generic_spring_works_at_one_dof_and_between_two() -> None:
    base = RIG.system("with_ring").stiffness
    dofs = RIG.system("with_ring").dofs
    one = system_with("spring@sun.u", stiffness=1e4).stiffness - base
    assert one[dofs.index("sun.u"), dofs.index("sun.u")] == pytest.approx(1e4)
    two = system_with("spring@carrier.x-sun.x", stiffness=1e4).stiffness - base
    assert two[dofs.index("carrier.x"), dofs.index("sun.x")] == pytest.approx(-1e4)
    derived = system_with("mass@planet2.x", mass=0.1).mass - RIG.system("with_ring").mass
    assert derived[dofs.index("planet2.zeta"), dofs.index("planet2.zeta")] == pytest.approx(0.1)


def test_effects_add_up_and_their_parameters_join_the_rigs() -> None:
    rig = rig_with_effects(
        RIG, [("flexible_support@ring", {"mass": 3.0, "stiffness": 2e7}), "local_damper@ring_support"]
    )
    name = "flexible_support@ring.stiffness"
    assert rig.parameters[name].value == 2e7
    assert rig.parameters[name].free
    assert name in rig.used("with_ring")
    assert name not in rig.used("no_ring")
    assert np.any(rig.system("with_ring").damping)
    np.testing.assert_array_equal(rig.system("no_ring").stiffness, RIG.system("no_ring").stiffness)
    families = {m.family for m in model_modes(rig, "with_ring")}
    assert families <= {"rotational", "translational", "rigid body"}


def test_mistakes_in_effects_come_with_a_hint() -> None:
    with pytest.raises(EmaError, match="did you mean 'mesh_stiffness_loss'"):
        parse_effect("mesh_stifness_loss@sun-planet1", RIG)
    with pytest.raises(EmaError, match="did you mean 'sun-planet2'"):
        parse_effect("mesh_stiffness_loss@sun-planet3", RIG, "no_ring")
    with pytest.raises(EmaError, match="form effect@place"):
        parse_effect("sensor_mass", RIG)
    with pytest.raises(EmaError, match="no place for this effect"):
        parse_effect("gyroscopic@storey1", frame(2))
    with pytest.raises(EmaError, match="did you mean 'fraction'"):
        rig_with_effects(RIG, [("mesh_stiffness_loss@sun-planet1", {"fracton": 0.3})])
    with pytest.raises(EmaError, match=r"fraction = 1\.3"):
        rig_with_effects(RIG, [("mesh_stiffness_loss@sun-planet1", {"fraction": 1.3})])
    with pytest.raises(EmaError, match="named twice"):
        rig_with_effects(RIG, ["sensor_mass@all", "sensor_mass@all"])
    with pytest.raises(EmaError, match="name=number"):
        parse_sized("sensor_mass@all:mass=heavy")


def test_effect_with_sizes_is_read_from_one_word() -> None:
    assert parse_sized("flexible_support@ring:mass=3,stiffness=2e7") == (
        "flexible_support@ring",
        {"mass": 3.0, "stiffness": 2e7},
    )
    assert parse_sized("sensor_mass@all") == ("sensor_mass@all", {})


OWN = """
from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.mechanics.assembly import Spring

EFFECT = Effect(
    id="oil_film",
    title="an oil film holds the sun sideways",
    parameters=(EffectParameter("stiffness", "N/m", 0.0, 1e5, 1e5, 0.0, 1e9),),
    find_places=lambda assembly: ("sun",) if assembly.has_dof("sun.x") else (),
    edit=lambda assembly, place, values: assembly.add(
        Spring("oil film", {"sun.x": 1.0}, values["stiffness"])
    ),
    signs="sun translation stiffer in x",
)
"""


def test_effect_of_the_user_is_one_file(tmp_path: Path) -> None:
    file = tmp_path / "oil_film.py"
    file.write_text(OWN, encoding="utf-8")
    library = effect_library([file])
    assert "oil_film" in library
    rig = rig_with_effects(RIG, [("oil_film@sun", {"stiffness": 5e5})], library)
    i = rig.system("no_ring").dofs.index("sun.x")
    gained = rig.system("no_ring").stiffness[i, i] - RIG.system("no_ring").stiffness[i, i]
    assert gained == pytest.approx(5e5)
    assert "oil_film" not in shipped_effects()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EFFECT = 3", "defines no EFFECT"),
        ("import nonsense_module_xyz", "does not run: ModuleNotFoundError"),
        ("def broken(:", "does not run: SyntaxError"),
        (OWN.replace("oil_film", "sensor_mass"), "already taken"),
    ],
)
def test_broken_effect_file_is_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "mine.py"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(EmaError, match=message) as caught:
        effect_library([file])
    assert str(file) in str(caught.value)
    with pytest.raises(EmaError, match="no such effect file"):
        load_effect_file(tmp_path / "none.py")


def test_a_parameter_tells_which_effect_it_belongs_to() -> None:
    """Places have dots as well: one at a body is not one at its coordinate."""
    rig = planetary()
    for label in ("spring@sun", "spring@sun.x", "mesh_stiffness_loss@sun-planet1"):
        placed = parse_effect(label, rig)
        for parameter in placed.effect.parameters:
            assert effect_of(placed.parameter_name(parameter.name)) == label
    assert effect_of("sun_mass") == ""


def test_no_more_can_be_lost_than_stands_at_a_place() -> None:
    """A spring of 4 kN/m to ground, one of 9 kN/m to the next body, and masses of 2 and 3 kg."""
    assembly = Assembly(
        ("a.x", "b.x"),
        (
            Mass("a", {"a.x": 1.0}, 2.0),
            Mass("b", {"b.x": 1.0}, 3.0),
            Spring("ground", {"a.x": -2.0}, 1000.0),  # twice the motion: four times the stiffness
            Spring("between", {"a.x": 1.0, "b.x": -1.0}, 9000.0),
            Spring("both", {"a.x": 1.0, "b.x": 1.0}, 500.0),
        ),
        {},
        0.01,
    )
    spring, mass = shipped_effects()["spring"], shipped_effects()["mass"]

    def least(effect: Effect, place: str) -> float:
        return effect.possible(assembly, place).parameters[0].minimum

    assert least(spring, "a.x") == pytest.approx(-4000.0)
    assert least(spring, "b.x") == 0.0
    assert least(spring, "b.x-a.x") == pytest.approx(-9000.0)
    assert least(mass, "b.x") == pytest.approx(-3.0)
    assert least(mass, "a.x-b.x") == 0.0
    damper = shipped_effects()["damper"]
    assert damper.possible(assembly, "a.x") is damper


def test_foam_that_carries_a_structure_does_not_make_small_springs_usual() -> None:
    """Four springs of 800 kN/m and five of 300 N/m to ground: the median of all would be the foam's."""
    bodies = [f"m{k}" for k in range(1, 6)]
    inner = [Spring(f"{a}{b}", {f"{a}.z": 1.0, f"{b}.z": -1.0}, 8e5) for a, b in pairwise(bodies)]
    foam = [Spring(f"foam {b}", {f"{b}.z": 1.0}, 300.0) for b in bodies]
    masses = [Mass(b, {f"{b}.z": 1.0}, 1.0) for b in bodies]
    dofs = tuple(f"{b}.z" for b in bodies)
    assert usual_stiffness(Assembly(dofs, (*masses, *inner, *foam))) == 4e5
    seats = [replace(f, stiffness=2e5) for f in foam]
    assert usual_stiffness(Assembly(dofs, (*masses, *inner, *seats))) == 1e5
    assert usual_stiffness(Assembly(dofs, (*masses, *foam))) == 150.0
