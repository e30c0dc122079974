"""Circle fit: exact on the theory it rests on, at the Cramér-Rao bound in noise, true on real hits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.assurance import mac
from ema_pipeline.modal.circle import (
    CircleSettings,
    attach_circles,
    average,
    circle_fits,
    fit_circle,
    identify_by_circle,
    on_circle,
)
from ema_pipeline.modal.circle.compare import average_told, disagreement
from ema_pipeline.modal.circle.geometry import algebraic_circle, geometric_circle
from ema_pipeline.modal.circle.identify import rank_one
from ema_pipeline.modal.types import ModalModel, Mode, StabilisationChart

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]


def sdof_mobility(f: Real, f_n: float, zeta: float, constant: complex = 1.0) -> Complex:
    w, w_n = 2 * np.pi * f, 2 * np.pi * f_n
    return np.asarray(1j * w * constant / (w_n**2 - w**2 + 2j * zeta * w_n * w))


def around(f_n: float, zeta: float, n: int, bandwidths: float = 1.0) -> Real:
    """Lines to either side, none of them at resonance."""
    return f_n * (1 + 2 * zeta * bandwidths * np.linspace(-0.97, 1.03, n))


def frf_set(
    f: Real, frf: Complex, record_s: float, variance: Real | None = None, decay: float = 0.0, n_in: int = 1
) -> FrfSet:
    outputs = tuple(Dof(f"p{k + 1}", "z") for k in range(frf.shape[0]))
    return FrfSet(
        frequency_hz=f,
        frf=frf,
        coherence=np.full(frf.shape, np.nan),
        variance=np.full(frf.shape, np.nan) if variance is None else variance,
        outputs=outputs,
        inputs=outputs[:n_in],
        quantities=("acceleration",) * len(outputs),
        hits=np.full(frf.shape[:2], 5),
        estimator="H1",
        record_s=record_s,
        response_decay_rad_s=decay,
        delay_s=np.zeros(n_in),
        band_hz=(float(f[1]), float(f[-1])),
        force_calibrated=True,
        sensor_mass_kg=np.zeros(len(outputs)),
    )


def accelerance(f: Real, poles: Complex, shapes: Real, n_in: int) -> Complex:
    """Σ s²·φφᵀ/(2jω_d)/(s - s_r) and conjugates."""
    s = 2j * np.pi * f
    frf = np.zeros((shapes.shape[1], n_in, f.size), dtype=complex)
    for pole, phi in zip(poles, shapes, strict=True):
        a = np.outer(phi, phi[:n_in])[:, :, None] / (2j * pole.imag)
        frf += s**2 * (a / (s - pole) + a.conj() / (s - pole.conjugate()))
    return frf


def poles_of(frequencies: Real, dampings: Real) -> Complex:
    w = 2 * np.pi * np.asarray(frequencies)
    zeta = np.asarray(dampings)
    return np.asarray(w * (-zeta + 1j * np.sqrt(1 - zeta**2)))


def modal_model(frfs: FrfSet, poles: Complex, shapes: Real, std: float = 1e-6) -> ModalModel:
    """What a pole estimator without error would hand on."""
    none = np.empty(0)
    modes = tuple(
        Mode(
            frequency_hz=abs(p) / (2 * np.pi),
            frequency_std_hz=std * abs(p) / (2 * np.pi),
            damping_ratio=-p.real / abs(p),
            damping_std=std * -p.real / abs(p),
            pole=complex(p),
            shape=phi.astype(complex),
            shape_std=np.zeros(phi.size),
            mpc=1.0,
            method="plscf",
        )
        for p, phi in zip(poles, shapes, strict=True)
    )
    return ModalModel(
        dofs=frfs.outputs,
        modes=modes,
        band_hz=frfs.band_hz,
        scaled=True,
        scaling_note="",
        references=frfs.inputs,
        frequency_hz=frfs.frequency_hz,
        synthesis=frfs.frf,
        outputs=frfs.outputs,
        inputs=frfs.inputs,
        chart=StabilisationChart(none.astype(int), none, none, none.astype(bool), none.astype(int)),
    )


def noisy(rng: np.random.Generator, frf: Complex, level: float, hits: int = 5) -> tuple[Complex, Real]:
    """Mean over hits and its variance; noise relative to each FRF's rms."""
    std = level * np.sqrt(hits) * np.sqrt(np.mean(np.abs(frf) ** 2, axis=2, keepdims=True) / 2)
    all_hits = frf + std * (
        rng.standard_normal((hits, *frf.shape)) + 1j * rng.standard_normal((hits, *frf.shape))
    )
    mean = all_hits.mean(axis=0)
    return mean, np.asarray(np.sum(np.abs(all_hits - mean) ** 2, axis=0) / (hits - 1) / hits)


THREE_POLES = poles_of(np.array([40.0, 62.0, 85.0]), np.array([0.01, 0.015, 0.008]))
THREE_SHAPES = np.array([[0.33, 0.59, 0.74], [0.74, 0.33, -0.59], [0.59, -0.74, 0.33]])


# ---- the circle itself


def test_circle_through_exact_points_is_exact_even_for_a_short_arc() -> None:
    points = (3 - 2j) + 0.7 * np.exp(1j * np.linspace(0.2, 0.9, 6))
    weights = np.array([1, 2, 3, 1, 1, 2]) / 10
    for fit in (algebraic_circle, geometric_circle):
        centre, radius = fit(points, weights)
        assert centre == pytest.approx(3 - 2j, abs=1e-9)
        assert radius == pytest.approx(0.7, abs=1e-9)


def test_geometric_circle_has_the_least_distance_of_all_circles() -> None:
    scipy_optimize = pytest.importorskip("scipy.optimize")
    rng = np.random.default_rng(0)
    points = np.exp(1j * rng.uniform(0, 4, 12)) + 0.05 * rng.standard_normal((2, 12)).T @ [1, 1j]
    weights = rng.uniform(0.5, 2, 12)
    weights /= weights.sum()
    centre, radius = geometric_circle(points, weights)

    def distances(p: Real) -> Real:
        return np.asarray(np.sqrt(weights) * (np.abs(points - complex(p[0], p[1])) - p[2]))

    truth = scipy_optimize.least_squares(distances, [0.0, 0.0, 1.0], xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    assert [centre.real, centre.imag, radius] == pytest.approx(truth, abs=1e-7)


# ---- one mode in one FRF


@pytest.mark.parametrize("zeta", [0.0005, 0.01, 0.1])
@pytest.mark.parametrize("n", [5, 8, 31])
def test_single_mode_is_exact_with_any_phase_and_offset(zeta: float, n: int) -> None:
    f = around(515.0, zeta, n)
    pure = sdof_mobility(f, 515.0, zeta, 3.0 * np.exp(0.8j))
    circle = fit_circle(f, pure + 0.4 * pure.max() * (1 - 2j))
    assert circle.natural_frequency_hz == pytest.approx(515.0, rel=1e-9)
    assert circle.damping_ratio == pytest.approx(zeta, rel=1e-7)
    assert circle.pair_damping == pytest.approx(zeta, rel=1e-6)
    assert circle.residual < 1e-9
    np.testing.assert_allclose(circle.contribution(f), pure, rtol=1e-6)
    # diameter of a mobility circle: modal constant over 2ζω_n
    assert 2 * circle.radius == pytest.approx(3.0 / (2 * zeta * 2 * np.pi * 515.0), rel=1e-7)


def test_scatter_in_noise_is_what_the_standard_deviations_say_and_at_the_cramer_rao_bound() -> None:
    rng = np.random.default_rng(1)
    f_n, zeta, n = 515.0, 0.01, 15
    f = around(f_n, zeta, n)
    pure = sdof_mobility(f, f_n, zeta)
    sigma = 0.02 * np.abs(pure).max() / 2  # per real and imaginary part
    found = []
    for _ in range(200):
        noise = sigma * (rng.standard_normal(n) + 1j * rng.standard_normal(n))
        c = fit_circle(f, pure + noise)
        found.append((c.natural_frequency_hz, c.damping_ratio, c.natural_frequency_std_hz, c.damping_std))
    values = np.array(found)
    scatter = values.std(axis=0)
    claimed = np.sqrt(np.mean(values**2, axis=0))[2:]
    assert scatter[:2] == pytest.approx(claimed, rel=0.15)
    assert abs(values[:, 1].mean() / zeta - 1) < 0.003

    # independent bound: numerical derivatives of B + D/(1 + jx) by all six unknowns
    def model(p: Real) -> Real:
        y = complex(p[0], p[1]) + sdof_mobility(f, p[4], p[5], complex(p[2], p[3]))
        return np.concatenate([y.real, y.imag])

    p = np.array([0, 0, 1, 0, f_n, zeta])
    steps = np.array([1e-7, 1e-7, 1e-6, 1e-6, 1e-4, 1e-7])
    jacobian = np.stack(
        [(model(p + e) - model(p - e)) / (2 * h) for e, h in zip(np.diag(steps), steps, strict=True)]
    )
    bound = np.sqrt(np.diag(np.linalg.inv(jacobian @ jacobian.T)))[4:] * sigma
    assert scatter[:2] == pytest.approx(bound, rel=0.15)


def test_too_few_lines_and_a_straight_line_are_refused_in_plain_words() -> None:
    with pytest.raises(EmaError, match="4 lines around the mode, at least 5"):
        fit_circle(np.arange(1.0, 5.0), np.exp(1j * np.arange(4)))
    with pytest.raises(EmaError, match="straight line"):
        fit_circle(np.arange(1.0, 9.0), (1 + 1j) * np.arange(8))


# ---- modes of a set of FRFs


def three_mode_frfs(noise: float = 0.0, decay: float = 0.0, n_in: int = 1) -> FrfSet:
    f = np.arange(0, 130, 0.1)
    frf = accelerance(f, THREE_POLES - decay, THREE_SHAPES, n_in)
    if not noise:
        return frf_set(f, frf, 10.0, decay=decay, n_in=n_in)
    mean, variance = noisy(np.random.default_rng(5), frf, noise)
    return frf_set(f, mean, 10.0, variance, decay=decay, n_in=n_in)


@pytest.mark.parametrize("decay", [0.0, 1.5])
def test_three_modes_in_1_percent_noise_with_the_window_taken_off(decay: float) -> None:
    frfs = three_mode_frfs(0.01, decay)
    model = modal_model(frfs, THREE_POLES, THREE_SHAPES)
    for mode, circles in zip(model.modes, circle_fits(frfs, model), strict=True):
        assert len(circles) == 3
        found = average(circles)
        half_width = mode.damping_ratio * mode.frequency_hz
        assert abs(found.frequency_hz - mode.frequency_hz) < 0.02 * half_width
        assert found.damping_ratio == pytest.approx(mode.damping_ratio, rel=0.02)
        assert np.median(circles[0].pair_damping) == pytest.approx(mode.damping_ratio, rel=0.02)


@pytest.mark.parametrize("decay", [0.0, 1.5])
@pytest.mark.parametrize("bandwidths", [0.25, 3.0])
def test_a_frequency_lies_where_the_frf_has_it_however_coarse_the_lines(
    bandwidths: float, decay: float
) -> None:
    poles = poles_of(np.array([40.0]), np.array([0.01]))
    seen = poles - decay
    step = bandwidths * -2 * seen[0].real / (2 * np.pi)
    f = 40.0 + step * (np.arange(-9, 10) + 0.3)
    frfs = frf_set(f, accelerance(f, seen, np.ones((1, 1)), 1), 1 / step, decay=decay)
    (circles,) = circle_fits(frfs, modal_model(frfs, poles, np.ones((1, 1))))
    for at in 40.0 * (1 + 0.01 * np.array([-1.0, 0.0, 1.0])):
        expected = accelerance(np.array([at]), seen, np.ones((1, 1)), 1)[0, 0, 0] / (2j * np.pi * at)
        assert abs(on_circle(circles[0], at) - expected) < 0.02 * circles[0].radius


def test_a_circle_without_width_does_not_widen_the_interval_of_its_mode() -> None:
    """Such a fit ends at a damping ratio of zero, beside the frequency, and its own σ is many times as large."""
    frfs = three_mode_frfs(0.01)
    model = modal_model(frfs, THREE_POLES, THREE_SHAPES)
    (good, *_), *_ = circle_fits(frfs, model)
    lost = replace(good, damping_ratio=1e-6, damping_std=2e-4, natural_frequency_hz=48.0)
    assert average_told([lost, good]) == average([good])
    mode = replace(model.modes[0], circles=(lost, lost, good))
    assert disagreement(mode, CircleSettings()) == ""
    assert disagreement(replace(mode, circles=(lost, lost)), CircleSettings()) == ""


def test_taking_neighbours_off_is_more_truthful() -> None:
    zeta = 0.01
    poles = poles_of(np.array([50.0, 53.5, 57.0]), np.array([zeta, zeta, zeta]))
    f = np.arange(0, 80, 0.05)
    frfs = frf_set(f, accelerance(f, poles, THREE_SHAPES, 1), 20.0)
    model = modal_model(frfs, poles, THREE_SHAPES)
    errors = []
    for remove in (True, False):
        fits = circle_fits(frfs, model, CircleSettings(remove_neighbours=remove))
        errors.append(max(abs(average(c).damping_ratio / zeta - 1) for c in fits))
    assert errors[0] < 0.02
    assert errors[0] < errors[1] / 4


def test_all_channels_are_fitted_when_asked_and_best_come_first() -> None:
    frfs = three_mode_frfs(0.01)
    model = modal_model(frfs, THREE_POLES, THREE_SHAPES)
    first = circle_fits(frfs, model, CircleSettings(channels_per_mode=1))
    every = circle_fits(frfs, model, CircleSettings(channels_per_mode="all"))
    assert [len(c) for c in first] == [1, 1, 1]
    assert [len(c) for c in every] == [3, 3, 3]
    # the third sensor moves most in the first mode
    assert first[0][0].output == every[0][0].output == Dof("p3", "z")


def test_fewer_than_3_percent_of_clean_separated_modes_are_flagged() -> None:
    rng = np.random.default_rng(7)
    flagged = total = 0
    for _ in range(12):
        dampings = rng.uniform(0.003, 0.02, 5)
        frequencies = [60.0]
        for k in range(1, 5):
            gap = rng.uniform(6, 25) * 2 * max(dampings[k - 1 : k + 1])
            frequencies.append(frequencies[-1] * (1 + gap))
        poles = poles_of(np.array(frequencies), dampings)
        shapes = rng.choice([-1, 1], (5, 4)) * rng.uniform(0.2, 2, (5, 4))
        record_s = 5 / (2 * float(np.min(-poles.real / (2 * np.pi))))
        f = np.arange(0, 1.2 * frequencies[-1], 1 / record_s)
        mean, variance = noisy(rng, accelerance(f, poles, shapes, 1), 0.01)
        frfs = frf_set(f, mean, record_s, variance)
        modes = attach_circles(frfs, modal_model(frfs, poles, shapes)).modes
        flagged += sum(bool(m.flags) for m in modes)
        total += len(modes)
        assert all(m.circles for m in modes)
    assert flagged < 0.03 * total


def with_damping_doubled(model: ModalModel, index: int) -> ModalModel:
    mode = model.modes[index]
    wrong = replace(mode, damping_ratio=2 * mode.damping_ratio, pole=2 * mode.pole.real + 1j * mode.pole.imag)
    return replace(model, modes=tuple(wrong if k == index else m for k, m in enumerate(model.modes)))


def test_a_wrong_damping_is_flagged_with_both_values() -> None:
    frfs = three_mode_frfs(0.01)
    model = modal_model(frfs, THREE_POLES, THREE_SHAPES)
    modes = attach_circles(frfs, with_damping_doubled(model, 2)).modes
    assert [bool(m.flags) for m in modes] == [False, False, True]
    assert "against 1.6 %" in modes[2].flags[0]
    assert modes[2].flags[0].endswith("unexplained")


def test_a_close_neighbour_is_named_as_the_reason() -> None:
    poles = poles_of(np.array([50.0, 52.0]), np.array([0.01, 0.01]))
    f = np.arange(0, 80, 0.05)
    frfs = frf_set(f, accelerance(f, poles, THREE_SHAPES[:2], 1), 20.0)
    modes = attach_circles(frfs, with_damping_doubled(modal_model(frfs, poles, THREE_SHAPES[:2]), 0)).modes
    assert "close neighbour at 52" in modes[0].flags[0]


def test_a_record_that_ends_too_early_is_named_as_the_reason() -> None:
    f = np.arange(0, 130, 1.0)
    frfs = frf_set(f, accelerance(f, THREE_POLES[:1], THREE_SHAPES[:1], 1), 1.0)
    model = with_damping_doubled(modal_model(frfs, THREE_POLES[:1], THREE_SHAPES[:1]), 0)
    flag = attach_circles(frfs, model).modes[0].flags[0]
    assert "leakage" in flag
    assert "1.6 lines in the half-power band" in flag


def duffing_accelerance(
    cubic: float, zeta: float, f_n: float, record_s: float, rate: float
) -> tuple[Real, Complex]:
    """Accelerance of m = 1 kg, ẍ + 2ζω ẋ + ω² x + cubic·x³ = f, from its free decay after a short blow."""
    n, fine = int(record_s * rate), 4
    step, w = 1 / (rate * fine), 2 * np.pi * f_n
    blow = np.zeros(n * fine + 1)
    blow[:33] = 100 * np.sin(np.pi * np.arange(33) / 32)

    def acceleration(x: float, v: float, force: float) -> float:
        return force - 2 * zeta * w * v - w * w * x - cubic * x**3

    x = v = 0.0
    response = np.zeros(n * fine)
    for k in range(n * fine):
        f0, f1 = float(blow[k]), float(blow[k + 1])
        response[k] = a1 = acceleration(x, v, f0)
        v2 = v + step / 2 * a1
        a2 = acceleration(x + step / 2 * v, v2, (f0 + f1) / 2)
        v3 = v + step / 2 * a2
        a3 = acceleration(x + step / 2 * v2, v3, (f0 + f1) / 2)
        v4 = v + step * a3
        a4 = acceleration(x + step * v3, v4, f1)
        x += step / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v += step / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    f = np.fft.rfftfreq(n, 1 / rate)
    return f, np.fft.rfft(response)[: f.size] / np.fft.rfft(blow[:-1])[: f.size]


def test_a_cubic_spring_distorts_the_circle_and_is_named_as_the_reason() -> None:
    zeta, f_n, record_s = 0.01, 100.0, 2.5
    w = 2 * np.pi * f_n
    flags = []
    for cubic in (0.0, 0.01 * w**2 / 6e-5**2):  # at the peak the spring is a third stiffer
        f, frf = duffing_accelerance(cubic, zeta, f_n, record_s, 1600.0)
        frfs = frf_set(f, frf[None, None], record_s)
        pole = poles_of(np.array([f_n]), np.array([zeta]))
        flags.append(attach_circles(frfs, modal_model(frfs, pole, np.ones((1, 1)))).modes[0].flags)
    assert flags[0] == ()
    assert "nonlinearity suspected: circle distorted" in flags[1][0]


# ---- the circle as an estimator of its own


@pytest.mark.parametrize("n_in", [1, 2])
def test_circle_alone_finds_modes_shapes_and_scale(n_in: int) -> None:
    frfs = three_mode_frfs(0.01, decay=0.8, n_in=n_in)
    found = identify_by_circle(frfs)
    assert len(found.modes) == 3
    assert found.scaled
    for mode, pole, shape in zip(found.modes, THREE_POLES, THREE_SHAPES, strict=True):
        assert mode.frequency_hz == pytest.approx(abs(pole) / (2 * np.pi), rel=2e-4)
        assert mode.damping_ratio == pytest.approx(-pole.real / abs(pole), rel=0.03)
        assert mac(mode.shape, shape)[0, 0] > 0.999
        assert np.linalg.norm(mode.shape) == pytest.approx(np.linalg.norm(shape), rel=0.05)
        assert mode.method == "circle"
        assert mode.mpc > 0.99
    inside = (found.frequency_hz > 39) & (found.frequency_hz < 86)
    lines = (frfs.frequency_hz > 39) & (frfs.frequency_hz < 86)
    measured, model = frfs.frf[..., lines], found.synthesis[..., inside]
    assert np.linalg.norm(measured - model) < 0.1 * np.linalg.norm(measured)


def test_a_roving_hammer_gives_shapes_at_the_points_it_struck() -> None:
    f = np.arange(0, 130, 0.1)
    frf = accelerance(f, THREE_POLES, THREE_SHAPES, 3)[:1]
    sensor = Dof("q", "z")
    frfs = replace(
        frf_set(f, frf, 10.0, n_in=3),
        outputs=(sensor,),
        inputs=tuple(Dof(f"p{k + 1}", "z") for k in range(3)),
        delay_s=np.zeros(3),
    )
    found = identify_by_circle(frfs)
    assert not found.scaled
    assert found.dofs == frfs.inputs
    for mode, shape in zip(found.modes, THREE_SHAPES, strict=True):
        assert mac(mode.shape, shape)[0, 0] > 0.999
        assert np.max(np.abs(mode.shape)) == pytest.approx(1.0)


def test_noise_without_a_resonance_is_refused() -> None:
    rng = np.random.default_rng(9)
    f = np.arange(0, 500, 1.0)
    frf = rng.standard_normal((3, 1, 500)) + 1j * rng.standard_normal((3, 1, 500))
    with pytest.raises(EmaError, match="no resonance between"):
        identify_by_circle(frf_set(f, frf, 1.0))


def test_rank_one_fills_gaps() -> None:
    rng = np.random.default_rng(10)
    a, b = (rng.standard_normal(n) + 1j * rng.standard_normal(n) for n in (5, 3))
    matrix = np.outer(a, b)
    gaps = matrix.copy()
    gaps[0, 1] = gaps[3, 2] = gaps[4, 0] = np.nan
    left, right = rank_one(gaps)
    np.testing.assert_allclose(np.outer(left, right), matrix, rtol=1e-6)


# ---- real hits


def test_five_real_hits_at_25600_hz(test_data: Path) -> None:
    hits = [
        np.loadtxt(p, delimiter=",", skiprows=1)
        for p in sorted((test_data / "realdata" / "five_hits_25600hz").glob("hit*.csv"))
    ]
    assert len(hits) == 5
    force, response = (np.fft.rfft([h[:, k - 2] for h in hits], axis=1) for k in (0, 1))
    cross, auto = np.mean(response * force.conj(), axis=0), np.mean(np.abs(force) ** 2, axis=0)
    h1 = cross / auto
    variance = np.sum(np.abs(response - h1 * force) ** 2, axis=0) / 5 / auto / 4
    n = hits[0].shape[0]
    f = np.fft.rfftfreq(n, 1 / 25600.0)
    keep = f < 5000
    frfs = frf_set(f[keep], h1[None, None, keep], n / 25600.0, variance[None, None, keep])
    frfs = replace(frfs, band_hz=(300.0, 4500.0))
    found = identify_by_circle(frfs)
    for truth in (810.2, 900.0, 2640.2, 3668.7):
        nearest = min(found.modes, key=lambda m: abs(m.frequency_hz - truth))
        assert nearest.frequency_hz == pytest.approx(truth, rel=1e-3)
        assert 0 < nearest.damping_ratio < 0.02
