"""Pairing and comparison against models whose answer is known by construction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from frequencies import from_frequencies
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.correlate.pairing import assign, close_groups, pair, pair_system, shape_agreement
from ema_pipeline.correlate.settings import CompareSettings, PairingSettings
from ema_pipeline.correlate.types import Pairing
from ema_pipeline.dof import Dof
from ema_pipeline.fit.comparison import band_differences, compare
from ema_pipeline.fit.parameters import FittedModes
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.inference import Posterior
from ema_pipeline.mechanics.frf import accelerance
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.mechanics.system import LinearSystem, sensor_rows
from ema_pipeline.observations.fitting import Fit, Model
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.mode_rows import FREQUENCY_NOISE, SHAPE_NOISE
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.rigs import load_rig
from ema_pipeline.rigs.types import ModelMode, Rig

SENSORS = (
    "carrier.x", "carrier.y", "sun.x", "sun.y", "planet1.x", "planet1.y", "planet2.x", "planet2.y",
    "carrier.u", "sun.u", "planet1.u", "planet2.u",
)  # fmt: skip
TRUTH = {"sun_planet_mesh_stiffness": 2e7, "sun_bearing_stiffness": 1.1e6, "modal_damping_ratio": 0.012}


def pair_with(
    rig: Rig,
    configuration: str,
    values: dict[str, float] | None,
    measured: MeasuredModes,
    settings: PairingSettings,
) -> Pairing:
    """Measured modes paired with the rig's at parameter values."""
    return pair_system(rig, rig.system(configuration, values), measured, settings)


def simulated(
    configuration: str = "no_ring",
    values: dict[str, float] | None = None,
    sensors: tuple[str, ...] = SENSORS,
    band: tuple[float, float] = (20.0, 2500.0),
) -> MeasuredModes:
    """Modes of the planetary rig in a band, exactly as its eigenproblem gives them."""
    system = load_rig("planetary").system(configuration, values or TRUTH)
    f, phi = normal_modes(system)
    inside = (f > band[0]) & (f < band[1])
    dofs = tuple(Dof.parse(s) for s in sensors)
    shapes = (sensor_rows(system, dofs) @ phi[:, inside]).T.astype(complex)
    f = f[inside]
    return MeasuredModes(
        configuration=configuration,
        frequency_hz=f,
        frequency_std_hz=1e-3 * f,
        damping_ratio=np.full(f.size, system.modal_damping_ratio),
        damping_std=np.full(f.size, 1e-3),
        shapes=shapes,
        shape_std=0.02 * np.abs(shapes).max(axis=1, keepdims=True) * np.ones(shapes.shape),
        dofs=dofs,
        band_hz=band,
    )


def test_every_mode_pairs_with_itself_when_the_model_is_the_truth() -> None:
    measured = simulated()
    pairing = pair_with(load_rig("planetary"), "no_ring", TRUTH, measured, PairingSettings())
    f, _ = normal_modes(load_rig("planetary").system("no_ring", TRUTH))
    assert len(pairing.pairs) == len(measured)
    for p in pairing.pairs:
        assert f[p.model] == pytest.approx(measured.frequency_hz[p.measured], rel=1e-9)
        assert p.mac > 0.999
    assert [u.reason for u in pairing.unpaired_model] == ["below band", "below band"]


def test_shapes_keep_the_pairs_right_when_the_nominal_model_is_off_by_a_fifth() -> None:
    # nearest frequencies would pair the 106 Hz mode with a neighbour here
    measured = simulated(values={"sun_bearing_stiffness": 0.7e6, "sun_planet_mesh_stiffness": 1e7})
    pairing = pair_with(load_rig("planetary"), "no_ring", None, measured, PairingSettings())
    nominal = load_rig("planetary").system("no_ring")
    _, phi = normal_modes(nominal)
    rows = sensor_rows(nominal, measured.dofs)
    assert measured.shapes is not None
    assert len(pairing.pairs) == len(measured)
    for p in pairing.pairs:
        if p.group < 0:
            a, b = measured.shapes[p.measured], rows @ phi[:, p.model]
            mac = abs(np.vdot(a, b)) ** 2 / (np.vdot(a, a).real * np.vdot(b, b).real)
            assert p.mac == pytest.approx(mac, rel=1e-6)
            assert mac > 0.8


def two_equal_modes(angle: float) -> tuple[LinearSystem, tuple[ModelMode, ...], MeasuredModes]:
    """A mass on equal springs in x and y, and a stiffer z: a pair of modes whose directions mean nothing."""
    stiffness = (2 * np.pi) ** 2 * np.diag([100.0**2, 100.0**2, 150.0**2])
    zero = np.zeros((3, 3))
    system = LinearSystem(("m.x", "m.y", "m.z"), np.eye(3), stiffness, zero, zero, 0.01)
    modes = tuple(ModelMode(i, f, 0.01, "elastic", np.eye(3)[i]) for i, f in enumerate((100.0, 100.0, 150.0)))
    c, s = np.cos(angle), np.sin(angle)
    shapes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], dtype=complex)
    f = np.array([99.9, 100.2, 149.0])
    unknown = np.full(3, np.nan)
    dofs = (Dof("m", "x"), Dof("m", "y"), Dof("m", "z"))
    return system, modes, MeasuredModes("all", f, 1e-3 * f, unknown, unknown, shapes, None, dofs)


def test_equal_modes_are_compared_by_their_plane_however_they_are_turned() -> None:
    system, modes, measured = two_equal_modes(np.pi / 4)
    pairing = pair(measured, modes, system, PairingSettings())
    assert [(p.measured, p.model) for p in pairing.pairs] == [(0, 0), (1, 1), (2, 2)]
    assert [p.mac for p in pairing.pairs] == pytest.approx([1.0, 1.0, 1.0])
    assert pairing.mac[0, 0] == pytest.approx(0.5)
    assert pairing.pairs[0].group == pairing.pairs[1].group >= 0
    assert pairing.pairs[2].group == -1


def test_every_measured_shape_has_its_own_share_in_the_plane_of_a_group() -> None:
    """Two model shapes span x and y; of four measured shapes 1, 1/2, 1/3 and 0 of the square lie in that plane."""
    shapes = np.array([[1, 1, 0, 0], [1, 0, 1, 0], [1, 0, 1, 1], [0, 0, 1, 0]], complex)
    places = tuple(Dof.parse(f"{b}.x") for b in "abcd")
    measured = replace(from_frequencies("default", [10.0, 11.0, 12.0, 13.0]), shapes=shapes, dofs=places)
    model = np.eye(3, 4, dtype=complex)
    single, grouped = shape_agreement(measured, model, np.array([0, 0, 1]))
    np.testing.assert_allclose(grouped[:, :2], np.array([[1, 1 / 2, 1 / 3, 0]] * 2).T, atol=1e-12)
    np.testing.assert_allclose(grouped[:, 2], single[:, 2])
    np.testing.assert_allclose(single[:, 0], [1 / 2, 1 / 2, 1 / 3, 0], atol=1e-12)
    unread = replace(
        measured, shapes=np.where(np.arange(4) == 3, np.nan, shapes)
    )  # the fourth sensor is broken
    _, grouped = shape_agreement(unread, model, np.array([0, 0, 1]))
    np.testing.assert_allclose(grouped[:, 0], [1, 1 / 2, 1 / 2, 0], atol=1e-12)


def test_two_sensors_do_not_tell_the_plane_of_two_equal_modes() -> None:
    """Two readings of two modes can be made up of them whatever they are: each is compared by itself."""
    two, model = np.array([[1.0, 0.5], [0.5, -1.0]], complex), np.eye(2, dtype=complex)
    places = (Dof.parse("a.x"), Dof.parse("a.y"))
    measured = replace(from_frequencies("default", [10.0, 10.1]), shapes=two, dofs=places)
    single, grouped = shape_agreement(measured, model, np.array([0, 0]))
    np.testing.assert_allclose(single, [[0.8, 0.2], [0.2, 0.8]])
    np.testing.assert_allclose(grouped, single)
    third = replace(
        measured, shapes=np.c_[two, [0.0, 0.0]], dofs=(*places, Dof.parse("b.x"))
    )  # a third one tells it
    _, grouped = shape_agreement(third, np.eye(2, 3, dtype=complex), np.array([0, 0]))
    np.testing.assert_allclose(grouped, 1.0)


def test_one_of_two_measured_modes_takes_the_model_mode_and_the_other_is_told_so() -> None:
    system, modes, measured = two_equal_modes(0.0)
    shapes = np.array([[1, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.02, 1.0]], dtype=complex)
    measured = replace(measured, shapes=shapes, frequency_hz=np.array([100.0, 150.5, 158.0]))
    pairing = pair(measured, modes, system, PairingSettings())
    assert [(p.measured, p.model) for p in pairing.pairs] == [(0, 0), (1, 2)]
    assert "taken by the measured mode at 150.5 Hz" in pairing.unpaired_measured[0].reason


def test_a_shape_unlike_any_is_refused_with_the_best_mac() -> None:
    measured = simulated()
    assert measured.shapes is not None
    shapes = measured.shapes.copy()
    shapes[3] = np.eye(12)[8] - np.eye(12)[2] + 0.5 * np.eye(12)[5]
    pairing = pair_with(
        load_rig("planetary"), "no_ring", TRUTH, replace(measured, shapes=shapes), PairingSettings()
    )
    refused = [u for u in pairing.unpaired_measured if u.index == 3]
    assert len(refused) == 1
    assert "shape unlike any: best MAC 0." in refused[0].reason


def test_a_frequency_far_from_any_is_refused_and_one_above_all_is_beyond_reach() -> None:
    measured = from_frequencies("no_ring", [51.0, 480.0, 5000.0])
    reasons = [
        u.reason
        for u in pair_with(
            load_rig("planetary"), "no_ring", None, measured, PairingSettings()
        ).unpaired_measured
    ]
    assert reasons == ["no model mode within 30 %", "beyond the model's reach: above its highest mode"]


def test_a_mode_of_bodies_without_sensors_is_said_to_be_not_measured() -> None:
    # the ring's torsion near 1 kHz cannot be seen from x and y of the carrier; planets carry the 161 Hz pair
    few = ("carrier.x", "carrier.y", "sun.x", "sun.y")
    measured = simulated(sensors=few)
    seen = [i for i, f in enumerate(measured.frequency_hz) if f < 60 or f > 90]
    rotational = [i for i in seen if np.abs(measured.shapes[i]).max() > 1e-6]  # type: ignore[index]
    kept = replace(
        measured,
        frequency_hz=measured.frequency_hz[rotational],
        frequency_std_hz=measured.frequency_std_hz[rotational],
        damping_ratio=measured.damping_ratio[rotational],
        damping_std=measured.damping_std[rotational],
        shapes=measured.shapes[rotational],  # type: ignore[index]
        shape_std=measured.shape_std[rotational],  # type: ignore[index]
    )
    pairing = pair_with(load_rig("planetary"), "no_ring", TRUTH, kept, PairingSettings())
    in_band = [u for u in pairing.unpaired_model if 20 < u.frequency_hz < 2500]
    assert in_band
    assert all(u.reason.startswith("not measured: it moves ") for u in in_band)


def test_modes_above_the_band_are_said_to_be_above_the_band() -> None:
    pairing = pair_with(
        load_rig("planetary"), "no_ring", TRUTH, simulated(band=(20.0, 500.0)), PairingSettings()
    )
    assert [u.reason for u in pairing.unpaired_model if u.frequency_hz > 500] == ["above band", "above band"]


def test_groups_chain_neighbours_and_part_distant_modes() -> None:
    groups = close_groups(np.array([100.0, 300.0, 101.0, 102.0, 0.0]), 0.02)
    assert groups[0] == groups[2] == groups[3]
    assert len({int(groups[0]), int(groups[1]), int(groups[4])}) == 3


def test_unless_set_otherwise_modes_within_two_per_cent_form_a_group() -> None:
    width = PairingSettings().group_width
    for second, alike in ((101.9, True), (102.1, False)):
        groups = close_groups(np.array([100.0, second]), width)
        assert (groups[0] == groups[1]) == alike


def as_drawn(measured: MeasuredModes, scatter: float) -> FittedModes:
    """The true model beside measured modes, all but the test itself scattering by `scatter` of its default."""
    rig = load_rig("planetary")
    observations = ModeObservations(rig, [prepare(measured)])
    problem = observations.problem((), {})
    x = np.zeros(len(problem.unknowns))
    for name, value in TRUTH.items():
        x[problem.unknowns.index[name]] = np.log(value / rig.parameters[name].value)
    own = (FREQUENCY_NOISE, SHAPE_NOISE)
    scatters = {n: s.default * (1.0 if n in own else scatter) for n, s in observations.scatters.items()}
    posterior = Posterior(problem.unknowns, x, scatters, problem.residuals(x, scatters))
    return FittedModes(observations, problem, Fit(Model(), posterior))


def test_differences_are_one_when_every_datum_is_off_by_one_standard_deviation() -> None:
    rig, measured = load_rig("planetary"), simulated()
    shifted = replace(
        measured,
        frequency_hz=measured.frequency_hz * np.exp(1e-3),
        damping_ratio=measured.damping_ratio * np.exp(-0.05),
        damping_std=0.05 * measured.damping_ratio * np.exp(-0.05),
        frequency_std_hz=1e-3 * measured.frequency_hz * np.exp(1e-3),
        shapes=None,
        shape_std=None,
        dofs=(),
    )
    pairing = pair_with(rig, "no_ring", TRUTH, shifted, PairingSettings())
    result = compare(as_drawn(shifted, 1e-9), {"no_ring": shifted}, None, {"no_ring": pairing})
    assert [m.frequency_z for m in result.modes] == pytest.approx([1.0] * len(measured), abs=1e-6)
    assert [m.damping_z for m in result.modes] == pytest.approx([-1.0] * len(measured), abs=1e-6)
    assert result.frequency_error == pytest.approx(len(measured) * 1e-6, rel=1e-2)


def test_the_error_is_that_of_the_fit() -> None:
    measured = simulated()
    pairing = pair_with(load_rig("planetary"), "no_ring", TRUTH, measured, PairingSettings())
    fitted = as_drawn(measured, 1.0)
    result = compare(fitted, {"no_ring": measured}, None, {"no_ring": pairing})
    assert result.error == fitted.posterior.error
    assert max(abs(m.frequency_z) for m in result.modes) < 1e-6


def test_a_sensor_that_reads_ten_percent_too_much_stands_out_among_the_dofs() -> None:
    measured = simulated()
    assert measured.shapes is not None
    shapes = measured.shapes.copy()
    shapes[:, 3] *= 1.1
    wrong = replace(measured, shapes=shapes)
    pairing = pair_with(load_rig("planetary"), "no_ring", TRUTH, wrong, PairingSettings())
    result = compare(as_drawn(wrong, 1.0), {"no_ring": wrong}, None, {"no_ring": pairing})
    assert max(result.dofs, key=lambda d: d.z).dof == "sun.y"


def frf_set(values: dict[str, float]) -> FrfSet:
    system = load_rig("planetary").system("no_ring", values)
    f = np.arange(0, 2560.5, 0.5)
    outputs, inputs = tuple(Dof.parse(s) for s in SENSORS), (Dof.parse("sun.y"), Dof.parse("planet1.x"))
    h = accelerance(system, f, sensor_rows(system, outputs), sensor_rows(system, inputs))
    nothing: NDArray[np.float64] = np.full(h.shape, np.nan)
    return FrfSet(
        f, h, nothing, nothing, outputs, inputs, ("acceleration",) * 12, np.ones((12, 2), dtype=np.int64),
        "H1", 2.0, 0.0, np.zeros(2), (20.0, 2000.0), True, np.zeros(12),
    )  # fmt: skip


def test_frf_bands_are_quiet_for_the_truth_and_loud_where_the_mesh_modes_are_off() -> None:
    system = load_rig("planetary").system("no_ring", TRUTH)
    quiet = band_differences("no_ring", system, frf_set(TRUTH), CompareSettings())
    assert max(b.z for b in quiet) < 1e-6
    softer = frf_set(TRUTH | {"sun_planet_mesh_stiffness": 1.6e7})
    loud = band_differences("no_ring", system, softer, CompareSettings())
    worst = max(loud, key=lambda b: b.z)
    assert worst.z > 10
    assert worst.low_hz > 900  # the mesh modes lie at 1.7 and 2.1 kHz; nothing low moves
    assert max(b.z for b in loud if b.high_hz < 100) < 1


def test_an_exponential_window_on_the_frfs_is_given_to_the_model_too() -> None:
    sigma, frfs = 15.0, frf_set(TRUTH)
    system = load_rig("planetary").system("no_ring", TRUTH)
    # h(t)·exp(-σt) is H(jω + σ): checked against the Fourier transform of the decayed impulse response
    omega, phi = normal_modes(system)
    omega = 2 * np.pi * omega
    rows_out, rows_in = sensor_rows(system, frfs.outputs), sensor_rows(system, frfs.inputs)
    s = sigma + 2j * np.pi * frfs.frequency_hz
    zeta = system.modal_damping_ratio
    denominator = s[None, :] ** 2 + 2 * zeta * omega[:, None] * s[None, :] + omega[:, None] ** 2
    windowed = s**2 * np.einsum("or,ir,rl->oil", rows_out @ phi, rows_in @ phi, 1 / denominator)
    with_window = replace(frfs, frf=windowed, response_decay_rad_s=sigma)
    bands = band_differences("no_ring", system, with_window, CompareSettings())
    assert max(b.z for b in bands) < 1e-6


def test_the_price_of_a_pair_is_one_at_the_frequency_tolerance_and_one_at_the_least_mac() -> None:
    settings = PairingSettings(frequency_tolerance=0.3, least_mac=0.4, refusal=1.2)

    def paired(distance: float, mac: float) -> bool:
        one = np.array([[mac]])
        return assign(np.array([[distance]]), one, one, settings) == {0: 0}

    assert paired(0.29, 0.99)  # 0.93 + 0.02
    assert not paired(0.29, 0.80)  # 0.93 + 0.33
    assert paired(0.0, 0.41)  # 0 + 0.98
    assert not paired(0.0, 0.39)  # below the least MAC
    assert not paired(0.31, 1.0)  # beyond the tolerance
    assert paired(0.15, 0.50)  # 0.25 + 0.83
    assert not paired(0.20, 0.50)  # 0.44 + 0.83


def test_of_two_members_of_a_group_the_one_with_the_better_plain_mac_is_taken() -> None:
    distance, grouped = np.zeros((1, 2)), np.ones((1, 2))
    for better in (0, 1):
        single = np.full((1, 2), 0.4)
        single[0, better] = 0.6
        assert assign(distance, grouped, single, PairingSettings()) == {0: better}


def test_a_measured_mode_goes_to_one_that_its_sensors_read_however_near_another_lies() -> None:
    """Two bodies in a plane with sensors along y alone: modes along x have nearly the same frequencies."""
    dofs = (Dof("a", "y"), Dof("b", "y"))
    shapes = np.array([[1.0, 0.9], [0.8, -1.0]])
    measured = MeasuredModes(
        "test", np.array([45.2, 96.2]), np.full(2, 0.01), np.full(2, 0.01), np.full(2, 1e-4),
        shapes.astype(complex), np.full((2, 2), 0.01), dofs, band_hz=(5.0, 200.0),
    )  # fmt: skip
    along_x = np.zeros((2, 2))
    model = np.vstack([along_x, shapes + 0.05]).astype(complex)
    single, grouped = shape_agreement(measured, model, np.arange(4))
    assert np.all(np.isnan(single[:, :2]))
    assert np.all(grouped[:, :2] == 0.0)
    distance = np.abs(np.log(measured.frequency_hz[:, None] / np.array([45.2, 96.2, 45.3, 96.3])))
    assert assign(distance, grouped, single, PairingSettings()) == {0: 2, 1: 3}
    unknown = replace(measured, shapes=None, shape_std=None)
    assert np.all(np.isnan(shape_agreement(unknown, model, np.arange(4))[1]))


def test_why_a_mode_stays_unpaired_is_said_with_its_numbers() -> None:
    rig = load_rig("frame")
    model_hz, _ = normal_modes(rig.system("default"))
    settings = PairingSettings(frequency_tolerance=0.1)
    table = from_frequencies("default", [0.8 * model_hz[0], model_hz[1]])
    pairing = pair_with(rig, "default", {}, table, settings)
    assert [(p.measured, p.model) for p in pairing.pairs] == [(1, 1)]
    assert [u.reason for u in pairing.unpaired_measured] == ["no model mode within 10 %"]
    # Without a stated band modes are looked for from 0.7 times the lowest to 1.3 times the highest measured one.
    assert [u.reason for u in pairing.unpaired_model] == ["no measured mode within 10 %", "above band"]
    narrow = from_frequencies("default", [1.2 * model_hz[1], 1.01 * model_hz[2]])
    pairing = pair_with(rig, "default", {}, narrow, PairingSettings())
    assert [u.reason for u in pairing.unpaired_model] == ["below band"]
