"""Shape correlation: limits known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.modal.assurance import (
    auto_mac,
    mac,
    mpc,
    real_shape,
    subspace_mac,
)

NAN = complex(np.nan, np.nan)


def random_shapes(seed: int, n: int, n_dofs: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((n, n_dofs)) + 1j * rng.standard_normal((n, n_dofs))


def test_mac_is_one_for_equal_shapes_of_any_scale_and_phase() -> None:
    shapes = random_shapes(1, 3, 7)
    turned = shapes * np.array([2.0, 1e-9j, -3e160 * np.exp(0.4j)])[:, None]
    assert np.diag(mac(shapes, turned)) == pytest.approx(1.0, abs=1e-12)


def test_mac_of_hand_computed_shapes() -> None:
    # |1·1 + 1·0|² / (2·1) = 1/2; orthogonal: 0; [1, j]ᴴ[1, 1] = 1 - j: 2/(2·2) = 1/2
    found = mac([[1, 1], [1, 1j]], [[1, 0], [1, -1], [1, 1]])
    assert found == pytest.approx(np.array([[0.5, 0.0, 1.0], [0.5, 0.5, 0.5]]), abs=1e-15)
    assert found.shape == (2, 3)


def test_mac_distinguishes_a_travelling_wave_from_its_reverse() -> None:
    assert mac([1, 1j], [1, -1j])[0, 0] == pytest.approx(0.0, abs=1e-15)


def test_mac_leaves_out_dofs_that_either_shape_lacks_pair_by_pair() -> None:
    a = np.array([[1, 2, NAN, 5], [1, 2, 3, 4]])
    b = np.array([[2, 4, 100, NAN], [NAN, NAN, 1, 1]])
    found = mac(a, b)
    assert found[0, 0] == pytest.approx(1.0)
    assert found[0, 1] == pytest.approx(1.0)  # one common DOF
    assert found[1, 0] == pytest.approx((2 + 8 + 300) ** 2 / (14 * (4 + 16 + 1e4)))
    assert found[1, 1] == pytest.approx(49 / (25 * 2))


def test_mac_without_common_dof_or_of_a_zero_shape_is_nan() -> None:
    assert np.isnan(mac([1, NAN], [NAN, 1])[0, 0])
    assert np.isnan(mac([0, 0], [1, 1])[0, 0])


def test_auto_mac_has_a_unit_diagonal_and_is_symmetric() -> None:
    found = auto_mac(random_shapes(2, 4, 5))
    assert np.diag(found) == pytest.approx(1.0)
    assert found == pytest.approx(found.T)


@pytest.mark.parametrize("phase", [0.0, 0.3, 1.2, -2.5])
def test_mpc_is_one_for_a_real_shape_at_any_phase(phase: float) -> None:
    shape = np.append(np.array([1.0, -2.0, 0.5]) * np.exp(1j * phase), NAN)
    assert mpc(shape) == pytest.approx(1.0, abs=1e-12)


def test_mpc_is_zero_for_a_travelling_wave() -> None:
    wave = np.exp(2j * np.pi * np.arange(8) / 8)
    assert mpc(wave) == pytest.approx(0.0, abs=1e-15)
    assert mpc([1, 1j]) == pytest.approx(0.0, abs=1e-15)


def test_mpc_of_a_hand_computed_shape() -> None:
    # φ = [1, j/2]: S_xx = 1, S_yy = 1/4, S_xy = 0: (3/4)²/(5/4)² = 9/25
    assert mpc([1, 0.5j]) == pytest.approx(9 / 25)


def test_mpc_agrees_with_the_eigenvalues_of_the_scatter_matrix() -> None:
    for shape in random_shapes(4, 5, 6):
        low, high = np.linalg.eigvalsh(scatter(shape))
        assert mpc(shape) == pytest.approx(((high - low) / (high + low)) ** 2)


def scatter(shape: np.ndarray) -> np.ndarray:
    xy = np.stack([shape.real, shape.imag])
    return xy @ xy.T


def test_real_shape_undoes_a_rotation_and_reports_its_phase() -> None:
    shape, phase = real_shape(np.array([2.0, -1.0, 0.5, NAN]) * np.exp(0.7j))
    assert shape[:3] == pytest.approx([2.0, -1.0, 0.5])
    assert np.isnan(shape[3])
    assert phase == pytest.approx(0.7)
    shape, phase = real_shape(np.array([-2.0, 1.0]) * np.exp(0.7j))
    assert shape == pytest.approx([2.0, -1.0])
    assert phase == pytest.approx(0.7 - np.pi)


def test_real_shape_is_the_best_of_all_rotations() -> None:
    for shape in random_shapes(5, 5, 6):
        turned, _ = real_shape(shape)
        angles = np.linspace(0, np.pi, 721)
        others = np.sum(np.imag(shape[None] * np.exp(-1j * angles)[:, None]) ** 2, axis=1)
        assert np.sum(turned.imag**2) <= others.min() * (1 + 1e-9)


def test_subspace_mac_is_the_mac_for_one_basis_shape() -> None:
    a, b = random_shapes(6, 2, 5)
    assert subspace_mac(a, b[None]) == pytest.approx(mac(a, b)[0, 0])


def test_subspace_mac_is_one_inside_a_degenerate_pair_however_it_is_turned() -> None:
    pair = random_shapes(7, 2, 6)
    inside = 0.3 * pair[0] - 2j * pair[1]
    assert subspace_mac(inside, pair) == pytest.approx(1.0)
    assert subspace_mac(inside, np.vstack([pair, pair[0] + pair[1]])) == pytest.approx(1.0)
    assert mac(inside, pair).max() < 0.999


def test_subspace_mac_of_a_shape_half_inside() -> None:
    assert subspace_mac([1, 0, 1], [[1, 0, 0], [0, 1, 0]]) == pytest.approx(0.5)
    assert subspace_mac([1, NAN, 1], [[1, 0, 0], [0, 1, 0]]) == pytest.approx(0.5)
    assert subspace_mac([0, 0, 1], [[1, 0, 0], [0, 1, 0]]) == pytest.approx(0.0)
