"""Modal identification on real measurements and on an independently simulated rig."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from real_modal import aircraft, five_hits, planetary

from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings

AIRCRAFT_HZ = [
    18.84,
    40.12,
    87.85,
    89.65,
    97.53,
    105.20,
    118.01,
    125.21,
    125.58,
    129.95,
    135.28,
    143.37,
    166.27,
]
"""Published for the structure by a commercial polyreference estimator; 97.07 sits at 97.53 in these data."""


def test_all_published_modes_of_the_aircraft_are_found_from_single_hits_and_no_others(
    test_data: Path,
) -> None:
    model = identify(aircraft(test_data / "realdata" / "aircraft_roving_hammer"), ModalSettings())
    found = [m.frequency_hz for m in model.modes]
    assert found == pytest.approx(AIRCRAFT_HZ, rel=3e-3)
    assert not model.scaled  # the sensors sit at points that were not hit


def test_modes_of_five_real_hits_agree_with_a_common_denominator_fit(test_data: Path) -> None:
    model = identify(five_hits(test_data / "realdata" / "five_hits_25600hz"), ModalSettings())
    found = np.array([m.frequency_hz for m in model.modes])
    for expected in (810.2, 900.0, 2640.2, 3668.7):
        assert np.min(np.abs(found - expected)) < 1e-3 * expected


@pytest.mark.parametrize(
    ("configuration", "expected"),
    [
        ("no_ring", [38.0, 47.5, 47.8, 53.4, 101.9, 108.8, 168.3, 168.5, 1380, 1461]),
        (
            "with_ring",
            [36.2, 46.0, 48.3, 101.4, 108.8, 167.9, 168.4, 311.6, 324.9, 875, 1107, 1171, 1569, 1612],
        ),
    ],
)
def test_planetary_rig_shows_every_mode_but_rigid_ones_with_one_percent_damping(
    test_data: Path, configuration: str, expected: list[float]
) -> None:
    # two planets: 12 modes, two of them rigid, without the ring; 15 modes, one of them rigid, with it
    model = identify(planetary(test_data / "blind" / "p1-healthy" / configuration), ModalSettings())
    assert [m.frequency_hz for m in model.modes] == pytest.approx(expected, rel=3e-3)
    for mode in model.modes:
        assert mode.damping_ratio == pytest.approx(0.01, rel=0.01)
