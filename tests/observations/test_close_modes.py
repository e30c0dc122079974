"""Close modes as groups: against single modes where these are far enough apart, and through the point where two
coincide.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ema_pipeline.dof import Dof
from ema_pipeline.observations.close_modes import Groups, Mixed, Slopes
from ema_pipeline.observations.mode_data import ModeData
from ema_pipeline.observations.sensing import turned_slopes

SENSORS = 7


def frame(matrix: np.ndarray, hz: float = 100.0) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies and shares of the modes of 1 + `matrix`, times (2π hz)²."""
    values, vectors = np.linalg.eigh(np.eye(len(matrix)) + matrix)
    return hz * np.sqrt(values), vectors


def rig(seed: int = 0, modes: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """What sensors read of the modes of a space, (s, c), and weights, (c, s)."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(SENSORS, modes)), rng.uniform(0.5, 2.0, (modes, SENSORS))


def groups(space: np.ndarray, matrix: np.ndarray, measured: np.ndarray, weight: np.ndarray) -> Groups:
    """The model's modes by `matrix`, held against the measured ones by another one."""
    hz, vectors = frame(matrix)
    measured_hz, measured_vectors = frame(measured)
    shapes = (space @ measured_vectors).T * np.arange(2.0, 2.0 + len(measured))[:, None]
    nothing = np.zeros((1, len(measured)))
    return Groups((space @ vectors)[None], shapes[None], weight[None], hz[None], measured_hz[None], nothing)


MEASURED = np.array([[0.01, 0.002], [0.002, -0.01]])


def test_a_model_that_is_right_reads_what_was_measured() -> None:
    space, weight = rig()
    found = groups(space, MEASURED, MEASURED, weight)
    assert found.told_apart.tolist() == [True]
    np.testing.assert_allclose(np.exp(found.log_frequency[0]), found.measured_hz[0], rtol=1e-12)
    np.testing.assert_allclose(found.turned, 0.0, atol=1e-8)
    factor = np.sum(found.measured * found.shapes, axis=2) / np.sum(found.shapes**2, axis=2)
    np.testing.assert_allclose(factor[..., None] * found.shapes, found.measured, rtol=1e-9)


def test_what_a_small_change_turns_is_what_it_turns_single_modes_by() -> None:
    space, weight = rig(3)
    change = 1e-4 * np.array([[0.3, 1.0], [1.0, -0.5]])
    found = groups(space, MEASURED + change, MEASURED, weight)
    hz, vectors = frame(MEASURED + change)
    np.testing.assert_allclose(np.exp(found.log_frequency[0]), hz, rtol=1e-6)
    for k in range(2):
        single, together = space @ vectors[:, k], (found.shapes + found.turned)[0, k]
        single = single * (together @ single) / (single @ single)
        np.testing.assert_allclose(together, single, atol=2e-4 * np.max(np.abs(together)))
        assert np.linalg.norm(found.turned[0, k]) > 1e-3 * np.linalg.norm(together)


def test_all_is_smooth_where_two_modes_of_the_model_coincide() -> None:
    """And in proportion to how far it is from there, while single shapes turn by a right angle at once."""
    space, weight = rig(1)
    path = np.linspace(-1.0, 1.0, 41)
    at = [groups(space, t * MEASURED, MEASURED, weight) for t in path]
    turned = np.array([g.turned[0] for g in at])
    logs = np.array([g.log_frequency[0] for g in at])
    assert all(g.told_apart[0] for g in at)
    steps = np.diff(logs, axis=0)
    np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), rtol=0.03)
    np.testing.assert_allclose(turned, 0.0, atol=1e-6)  # the same eigenvectors all the way
    other = np.array([[-0.01, 0.0], [0.0, 0.01]])
    aside = [groups(space, t * (other - MEASURED) + MEASURED, MEASURED, weight) for t in (0.1, 0.2, 0.4, 0.8)]
    size = [np.linalg.norm(g.turned) for g in aside]
    np.testing.assert_allclose(size, size[0] * np.array([1.0, 2.0, 4.0, 8.0]), rtol=1e-6)


def test_how_modes_mix_that_are_nearer_than_frequencies_are_known_counts_little() -> None:
    space, weight = rig(2)
    change = 1e-3 * np.array([[0.0, 1.0], [1.0, 0.0]])
    known = groups(space, MEASURED + change, MEASURED, weight)
    blurred = replace(known, uncertain=np.full((1, 2), 0.02))
    # their eigenvalues are 0.02 apart, and known to 0.02 · 2 · √2
    np.testing.assert_allclose(
        np.linalg.norm(blurred.turned) / np.linalg.norm(known.turned), 1 / (1 + 8.0), rtol=0.05
    )


def test_modes_that_sensors_cannot_tell_apart_are_said_to_be() -> None:
    space, weight = rig()
    same = space.copy()
    same[:, 1] = 1.01 * space[:, 0] + 1e-3
    assert not groups(same, MEASURED, MEASURED, weight).told_apart[0]
    found = groups(space, MEASURED, MEASURED, weight)
    twins = found.measured.copy()
    twins[0, 1] = 0.9 * twins[0, 0]
    two = replace(found, measured=twins)
    assert not two.told_apart[0]
    both = Groups(*(np.concatenate([getattr(found, n), getattr(two, n)]) for n in found.__dataclass_fields__))
    assert both.told_apart.tolist() == [True, False]
    assert both.only(both.told_apart).read.shape == (1, SENSORS, 2)


@pytest.mark.parametrize("modes", [2, 3, 4])
def test_derivatives_are_those_of_differences(modes: int) -> None:
    rng = np.random.default_rng(modes)
    space, weight = rng.normal(size=(12, modes)), rng.uniform(0.5, 2.0, (modes, 12))
    measured = _symmetric(rng, modes, 0.02)
    basis, by = _symmetric(rng, modes, 0.02), [_symmetric(rng, modes, 0.05) for _ in range(3)]
    shifted = rng.normal(size=(3, 12, modes))
    noise = rng.normal(size=(2, modes, 12))

    def at(x: np.ndarray) -> Groups:
        here = basis + np.einsum("j,jab->ab", x[:3], np.array(by))
        moved = space + np.einsum("j,jsm->sm", x[:3], shifted)
        found = groups(moved, here, measured, weight)
        given = groups(space, measured, measured, weight).measured + 0.05 * noise[0] + x[3] * noise[1]
        return replace(found, measured=given)

    x = np.array([0.02, -0.01, 0.03, 0.1])
    found, (_, vectors) = at(x), frame(basis + np.einsum("j,jab->ab", x[:3], np.array(by)))
    square = (2 * np.pi * 100.0) ** 2
    read, reduced = np.zeros((modes, 12, 4)), np.zeros((modes, modes, 3))
    for j in range(3):
        read[:, :, j] = (shifted[j] @ vectors).T
        reduced[:, :, j] = square * (vectors.T @ by[j] @ vectors)
    slopes = Slopes(np.zeros((modes, 4)), read, np.zeros(read.shape))
    at_last = np.array([[k, 3] for k in range(modes)])
    members, between = np.arange(modes)[None], np.arange(modes**2).reshape(modes, modes)
    # measured shapes are less what unknowns say they hold of others
    found.turn_slopes(slopes, members, reduced.reshape(-1, 3), between, Mixed(at_last, -noise[1]))
    for j in range(4):
        h = np.zeros(4)
        h[j] = 1e-6
        ends = at(x - h), at(x + h)
        for name in ("log_frequency", "shapes", "turned"):
            change = (getattr(ends[1], name) - getattr(ends[0], name)) / 2e-6
            expected = getattr(slopes, name)[None, ..., j]
            np.testing.assert_allclose(expected, change, atol=1e-5 * np.max(np.abs(change)) + 1e-9)


def _symmetric(rng: np.random.Generator, n: int, size: float) -> np.ndarray:
    matrix = rng.normal(size=(n, n))
    return np.asarray(size * (matrix + matrix.T))


def data(hz: list[float], sensors: int = 8, **more: np.ndarray) -> ModeData:
    m = len(hz)
    shapes = np.random.default_rng(5).normal(size=(m, sensors))
    return ModeData(
        "all", np.log(hz), np.full(m, 1e-4), np.full(m, np.log(0.001)), np.full(m, 0.1),
        shapes, np.full((m, sensors), 0.01), tuple(Dof("m", d) for d in "abcdefgh"[:sensors]), (1.0, 1e3), **more,
    )  # fmt: skip


def test_neighbours_are_of_one_group_as_far_as_sensors_tell_them_apart() -> None:
    hz = [10.0, 10.2, 20.0, 30.0, 30.5, 31.0, 32.0]
    assert data(hz).group.tolist() == [0, 0, -1, 2, 2, 2, -1]
    assert data(hz, sensors=5).group.tolist() == [0, 0, -1, -1, -1, -1, -1]
    chain = [100.0, 101.0, 102.5, 103.0, 104.0]
    assert data(chain).group.tolist() == [0, 0, 1, 1, 1]  # at most four
    assert data([]).group.tolist() == []
    twin = data([10.0, 10.001, 50.0])
    twin.shapes[1] = twin.shapes[0]
    assert twin.double.tolist() == [True, True, False]
    assert twin.group.tolist() == [-1, -1, -1]


def test_a_mode_that_no_sensor_reads_has_no_angle_that_turns() -> None:
    read, slope = np.zeros((1, 2), complex), np.zeros((1, 2, 3), complex)
    np.testing.assert_array_equal(turned_slopes(read, slope), np.zeros((1, 2, 3)))
