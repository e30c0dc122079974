"""Pole estimators against sdypy-EMA, NumPy, and systems known by hand."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from simulate_modal import TrueSystem, random_system

from ema_pipeline.modal.basis import pole_functions, real_columns, residual_columns
from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.engines import complete_block
from ema_pipeline.modal.fit import Estimate, moved, newton_step, shapes_by_lines, solve_linear
from ema_pipeline.modal.lscf import common_denominator_poles
from ema_pipeline.modal.noise_kernel import slopes
from ema_pipeline.modal.normal_equations import fractions, normal_equations, numerator
from ema_pipeline.modal.plscf import polyreference_poles
from ema_pipeline.modal.pole_tracks import link
from ema_pipeline.modal.poles import PoleSet
from ema_pipeline.modal.roots import stable_roots


def noisy(
    system: TrueSystem, frequency: np.ndarray, n_out: int, n_in: int, noise: float, seed: int
) -> np.ndarray:
    rng = np.random.default_rng(seed)
    frf = system.accelerance(frequency, list(range(n_out)), list(range(n_in)))
    return frf + noise * np.abs(frf).mean() * (
        rng.standard_normal(frf.shape) + 1j * rng.standard_normal(frf.shape)
    )


def test_lscf_gives_the_poles_of_sdypy_at_the_same_order() -> None:
    from sdypy import EMA

    system = random_system(np.random.default_rng(0), n_modes=8, n_dofs=6, low_hz=100, high_hz=900)
    frequency = np.linspace(0, 1000, 2001)
    frf = noisy(system, frequency, 6, 1, 0.01, 1)[:, 0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        peer = EMA.Model(frf, frequency, lower=20, upper=1000, pol_order_high=30)
        peer.get_poles(show_progress=False)
    n, first = len(peer.freq), int(np.argmin(np.abs(peer.freq - 20)))
    step = 2 * np.pi * (peer.freq[1] - peer.freq[0])
    ours = common_denominator_poles(peer.frf[:, first:], step, first, n - 1, list(range(2, 61, 2)))
    for theirs, mine in zip(peer.all_poles, ours, strict=True):
        top = 2 * np.pi * peer.freq[-1]
        stable = theirs[(theirs.imag > 1e-6 * top) & (theirs.imag < 0.999 * top) & (theirs.real < 0)]
        for pole in stable:
            assert np.min(np.abs(mine - pole)) < 1e-9 * abs(pole)


def polynomial(z: np.ndarray, real: np.ndarray) -> np.ndarray:
    """Ascending coefficients from the roots of the upper half plane and the real roots."""
    return np.real(np.poly(np.concatenate([z, z.conj(), real])))[::-1]


def test_stable_roots_are_those_that_numpy_finds() -> None:
    rng = np.random.default_rng(3)
    polynomials = []
    for n in (1, 4, 12, 30, 40):
        angle, radius = rng.uniform(0.1, 3.0, n // 2), rng.uniform(0.7, 1.3, n // 2)
        polynomials.append(
            polynomial(radius * np.exp(1j * angle), rng.uniform(-1.3, 1.3, n % 2 + 2 * (n > 20)))
        )
    for c, found in zip(polynomials, stable_roots(polynomials), strict=True):
        expected = np.roots(c[::-1])
        expected = expected[(expected.imag < 0) & (np.abs(expected) > 1)]
        assert len(found) == len(expected)
        assert all(np.min(np.abs(found - z)) < 1e-9 for z in expected)


def test_stable_roots_close_to_one_another_and_close_to_the_circles_are_all_found() -> None:
    rng = np.random.default_rng(4)
    others = 0.85 * np.exp(1j * np.linspace(0.05, 3.1, 16))
    for gap in (1e-2, 1e-3, 1e-4):
        pair = 1.003 * np.exp(1j * rng.uniform(0.3, 2.8)) * np.array([1, 1 + gap * 1j, 1 + 0.5 * gap])
        rim = (1 + gap**2) * np.exp(1j * rng.uniform(0.3, 2.8, 1))
        outside = 1.601 * np.exp(1j * rng.uniform(0.3, 2.8, 1))
        c = polynomial(np.concatenate([pair, rim, outside, others]), np.array([1.2, -1.05, 0.9]))
        found = stable_roots([c])[0]
        assert len(found) == 4
        power = found[:, None] ** np.arange(len(c))
        assert np.all(np.abs(power @ c) < 1e-14 * (np.abs(power) @ np.abs(c)))  # as small as rounding allows
        assert min(abs(a - b) for i, a in enumerate(found) for b in found[:i]) > 0.1 * gap


def test_roots_of_noisy_charts_equal_companion_eigenvalues() -> None:
    rng = np.random.default_rng(15)
    for noise, lines, channels in ((0.0, 300, 2), (1e-4, 600, 5), (0.3, 900, 3)):
        system = random_system(rng, n_modes=6, n_dofs=channels, low_hz=0.1 * lines, high_hz=0.9 * lines)
        frf = noisy(system, np.arange(lines + 1.0), channels, 1, noise, 16)
        orders = list(range(30, 81, 10))
        equations = normal_equations(frf, np.ones(lines + 1), orders[-1], 0, lines)
        denominators = [f.denominator[:, 0, 0] for f in fractions(equations, orders)]
        for c, found in zip(denominators, stable_roots(denominators), strict=True):
            z = np.roots(c[::-1])
            radius = np.abs(z)
            expected = z[(z.imag < -1e-9) & (radius > 1 + 1e-9) & (radius < 1.6)]
            assert all(np.min(np.abs(found - e)) < 1e-9 for e in expected)
            assert len(found) <= np.count_nonzero((z.imag < 1e-9) & (radius > 1 - 1e-9))


@pytest.mark.parametrize(("first", "grid"), [(0, 190), (20, 210), (40, 300)])
def test_denominators_of_all_orders_equal_those_of_a_direct_least_squares_fit(first: int, grid: int) -> None:
    system = random_system(np.random.default_rng(5), n_modes=3, n_dofs=3, low_hz=10, high_hz=90)
    frequency = np.linspace(5, 100, 191)
    frf = noisy(system, frequency, 3, 2, 0.01, 6)
    weight = np.random.default_rng(7).uniform(0.5, 2.0, 191)
    line = first + np.arange(191)
    half = np.where((line == 0) | (line == grid), 0.5, 1.0) * weight
    equations = normal_equations(frf, weight, 6, first, grid)
    for fraction in fractions(equations, [1, 3, 6]):
        n = fraction.order
        basis = np.exp(-1j * np.pi * line / grid)[:, None] ** np.arange(n + 1)
        blocks, right = [], []
        for o in range(3):
            known = np.zeros((191, 3, n + 1), complex)
            known[:, o] = basis
            unknown = (basis[:, :n, None] * frf[o].T[:, None, :]).reshape(191, 2 * n)
            row = np.concatenate([-known.reshape(191, -1), unknown], axis=1) * np.sqrt(half)[:, None]
            blocks.append(row)
            right.append(-(basis[:, n, None] * frf[o].T) * np.sqrt(half)[:, None])
        a, b = np.concatenate(blocks), np.concatenate(right)
        a, b = np.concatenate([a.real, a.imag]), np.concatenate([b.real, b.imag])
        direct = np.linalg.lstsq(a, b, rcond=None)[0]
        numerators, denominators = direct[: 3 * (n + 1)], direct[3 * (n + 1) :].reshape(n, 2, 2)
        assert np.allclose(fraction.denominator[:-1], denominators, rtol=1e-6, atol=1e-8)
        assert np.allclose(numerator(equations, fraction).reshape(-1, 2), numerators, rtol=1e-6, atol=1e-8)


def test_polyreference_finds_both_modes_of_a_repeated_pole_with_their_shapes() -> None:
    rng = np.random.default_rng(8)
    shapes = rng.standard_normal((3, 6))
    system = TrueSystem(np.array([50.0, 70.0, 70.0]), np.array([0.01, 0.01, 0.01]), shapes)
    frequency = np.linspace(30, 100, 561)
    frf = noisy(system, frequency, 6, 2, 1e-4, 9)
    poles = polyreference_poles(2 * np.pi * frequency, frf, np.ones(561), list(range(2, 25)))
    top = poles.take((poles.order == 24) & (np.abs(poles.frequency_hz - 70) < 0.2))
    assert len(top.pole) == 2
    basis = np.linalg.qr(shapes[1:].T)[0]
    for shape in top.shape:
        inside = np.linalg.norm(basis.T @ shape) / np.linalg.norm(shape)
        assert inside > 0.999


@pytest.mark.parametrize("rest_s", [np.inf, 0.8])
def test_derivative_of_the_basis_equals_its_difference_quotient(rest_s: float) -> None:
    omega = np.linspace(100, 200, 11)
    s = np.array([-2 + 150j])
    u1, d = pole_functions(omega, s, rest_s)
    for step in (1e-5, 1e-5j):
        u2, _ = pole_functions(omega, s + step, rest_s)
        assert np.allclose((u2 - u1) / step, d, rtol=1e-4)


@pytest.mark.parametrize("rest_s", [np.inf, 0.8])
def test_columns_of_a_residue_add_up_to_the_pole_and_its_conjugate(rest_s: float) -> None:
    omega, residue = np.linspace(100, 200, 11), 0.3 - 0.7j
    s = np.array([-2 + 150j, -30 + 199j])
    columns, derivatives = real_columns(omega, s, rest_s)
    for r in range(2):
        for made, k in ((columns, 0), (derivatives, 1)):
            own, mirrored = (pole_functions(omega, p, rest_s)[k][r] for p in (s, s.conj()))
            whole = residue.real * made[2 * r] + residue.imag * made[2 * r + 1]
            assert np.allclose(whole, residue * own + residue.conjugate() * mirrored, rtol=1e-12)


def test_shapes_made_some_lines_at_a_time_are_those_of_all_lines_at_once() -> None:
    rng = np.random.default_rng(3)
    omega, shape = np.linspace(100, 200, 700), (5, 2, 700)
    frf = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    weight = rng.uniform(0.5, 2, size=shape)
    data = FitData(omega, frf, np.ones(shape), np.ones((5, 2), dtype=bool), 3.0, False)
    poles = np.array([-1 + 120j, -2 + 180j])
    estimate = Estimate(poles, np.array([[1, 0.5j], [0.2, 1]]))
    blocks = [slice(k, min(k + 90, 700)) for k in range(0, 700, 90)]
    found = shapes_by_lines(
        data, lambda lines: (frf[..., lines], weight[..., lines]), blocks, estimate
    ).shapes
    # the same by plain least squares of every row, residual terms of every FRF beside the shapes
    columns, residual = real_columns(omega, poles, 3.0)[0], residual_columns(omega)
    for o in range(5):
        rows, right = [], []
        for i in range(2):
            part = estimate.participation[:, i, None]
            turned = np.empty_like(columns)
            turned[0::2] = part.real * columns[0::2] + part.imag * columns[1::2]
            turned[1::2] = part.real * columns[1::2] - part.imag * columns[0::2]
            own = [residual if k == i else np.zeros_like(residual) for k in range(2)]
            size = np.sqrt(weight[o, i])
            rows.append(np.concatenate([turned, *own]) * size)
            right.append(frf[o, i] * size)
        a, b = np.concatenate(rows, axis=1), np.concatenate(right)
        plain = np.linalg.lstsq(np.concatenate([a.real, a.imag], axis=1).T, np.concatenate([b.real, b.imag]))[
            0
        ]
        assert np.allclose(found[o], plain[:4:2] + 1j * plain[1:4:2], rtol=1e-6)


def test_slopes_of_the_noise_law_equal_sums_over_lines() -> None:
    rng = np.random.default_rng(4)
    rows, refs, lines, nodes = 3, 2, 130, 4
    starts = np.ceil((lines - 1) / (nodes - 1) * np.arange(nodes)).astype(np.int64)
    starts[-1] = lines
    hats = np.maximum(
        0, 1 - np.abs(np.arange(lines) / ((lines - 1) / (nodes - 1)) - np.arange(nodes)[:, None])
    )
    power = rng.exponential(size=(rows, refs, lines))
    power[0, 0, ::7], power[1, 1, 3] = np.nan, 0.0
    response = (rng.normal(size=(rows, lines, refs)) + 1j * rng.normal(size=(rows, lines, refs))).swapaxes(
        1, 2
    )
    measured = np.array([[True, True], [True, True], [True, False]])
    floor, level = np.full((rows, refs), 1e-3), rng.uniform(0.5, 1, size=(rows, refs))
    alpha, shape = rng.uniform(0.5, 2, size=(2, rows, refs, nodes))
    variance = (alpha @ hats) * np.abs(response) ** 2 + level[..., None] * (shape @ hats) + floor[..., None]
    known = measured[..., None] & (power > 0)
    less = np.where(known, 1 / variance, 0.0)
    more = np.where(known, np.maximum(power, floor[..., None]) / variance**2, 0.0)
    for common, by in ((True, np.abs(response) ** 2), (False, 1.0)):
        out = np.empty((2, rows, refs, nodes))
        spacing = (lines - 1) / (nodes - 1)
        slopes(
            power, np.abs(response) ** 2, measured, floor, alpha, shape, level, starts, spacing, common, out
        )
        assert np.allclose(out[0], (less * by) @ hats.T, rtol=1e-10)
        assert np.allclose(out[1], (more * by) @ hats.T, rtol=1e-10)


def test_basis_of_a_cut_record_equals_the_transform_of_the_cut_decay() -> None:
    rate, n, t0 = 4096.0, 4096, 100
    s = -1.5 + 2j * np.pi * 63.3
    t = (np.arange(n) - t0) / rate
    decay = np.where(t >= 0, np.exp(s * np.maximum(t, 0)), 0.0)
    decay[t0] = 0.5  # half of the jump belongs to the sample at the hit
    omega = 2 * np.pi * np.arange(30, 100) * rate / n
    spectrum = np.array([np.sum(decay * np.exp(-1j * w * t)) for w in omega]) / rate
    u, _ = pole_functions(omega, np.array([s]), (n - t0) / rate)
    assert np.max(np.abs(u[0] - spectrum)) < 2e-3 * np.max(np.abs(spectrum))


def test_gauss_newton_gradient_equals_the_difference_quotient_of_the_cost() -> None:
    rng = np.random.default_rng(11)
    system = random_system(rng, n_modes=2, n_dofs=4, low_hz=40, high_hz=60)
    frequency = np.linspace(30, 70, 161)
    frf = noisy(system, frequency, 4, 2, 0.02, 12)
    data = FitData(
        2 * np.pi * frequency,
        frf,
        np.full(frf.shape, np.nan),
        np.ones((4, 2), bool),
        np.inf,
        transposed=False,
    )
    weight = rng.uniform(0.5, 2.0, frf.shape)
    estimate = Estimate(system.poles * (1 + 0.001j), np.array([[1.0, 0.3 - 0.1j], [0.4 + 0.2j, 1.0]]))
    solution = solve_linear(data, weight, estimate)
    gradient = newton_step(estimate, solution).gradient
    for k in range(len(gradient)):
        size = 1e-4 if k < 4 else 1e-6
        costs = []
        for sign in (-1, 1):
            change = np.zeros(len(gradient))
            change[k] = sign * size
            costs.append(solve_linear(data, weight, moved(estimate, change)).cost)
        slope = (costs[1] - costs[0]) / (2 * size)
        assert slope == pytest.approx(-2 * gradient[k], rel=1e-3, abs=1e-6 * np.abs(gradient).max())


def test_tracks_do_not_merge_neighbours_half_a_percent_apart() -> None:
    orders = np.repeat(np.arange(10, 20), 2)
    rng = np.random.default_rng(13)
    frequency = np.tile([100.0, 100.5], 10) * (1 + 1e-5 * rng.standard_normal(20))
    pole = 2 * np.pi * frequency * (-0.002 + 1j)
    shape = np.tile(np.eye(2, 4, dtype=complex), (10, 1))
    tracks = link(PoleSet(orders, pole, shape, np.ones((20, 1), complex), tuple(range(10, 20))))
    assert len(tracks.representative) == 2
    assert np.all(tracks.votes == 1.0)


def test_poles_that_wander_from_order_to_order_are_no_candidates() -> None:
    rng = np.random.default_rng(14)
    pole = 2 * np.pi * rng.uniform(50, 500, 40) * (-0.01 + 1j)
    shape = rng.standard_normal((40, 8)) + 1j * rng.standard_normal((40, 8))
    tracks = link(PoleSet(np.arange(40), pole, shape, np.ones((40, 1), complex), tuple(range(40))))
    assert len(tracks.representative) == 0


def test_largest_complete_block_leaves_out_a_reference_that_was_rarely_used() -> None:
    measured = np.ones((10, 3), bool)
    measured[1:, 2] = False
    rows, references = complete_block(measured)
    assert rows.tolist() == list(range(10))
    assert references.tolist() == [0, 1]
