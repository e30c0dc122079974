"""A frequency that moves from level to level by more than any drift: no doubt that the structure is not linear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ema_pipeline.levels.types import LevelStudy, ModeLevels

MODE = ModeLevels(
    mode=0,
    frequency_hz=np.array([76.7, 77.7, 80.2]),
    frequency_std_hz=np.full(3, 0.05),
    damping_ratio=np.full(3, 0.008),
    damping_std=np.full(3, 0.001),
    amplitude_m=np.full((3, 1), 1e-4),
    frequency_p=0.2,
    damping_p=0.3,
    depends=False,
    trend="",
)


@pytest.mark.parametrize(
    ("hz", "damping", "std", "far"),
    [
        ([76.7, 77.7, 80.2], 0.008, 0.05, True),
        ([80.2, np.nan, 76.7], 0.008, 0.05, True),
        ([76.7, 80.2, 77.7], 0.008, 0.05, False),  # up and down is scatter
        ([76.7, 77.7, 80.2], 0.03, 0.05, False),  # within the peak
        ([76.7, 77.7, 80.2], 0.008, 0.6, False),  # within what is known
        ([76.7, 76.9, 77.3], 0.001, 0.01, False),  # as far as a laboratory that warms up moves a sharp peak
        ([np.nan, np.nan, 80.2], 0.008, 0.05, False),
    ],
)
def test_a_mode_moves_far(hz: list[float], damping: float, std: float, far: bool) -> None:
    mode = replace(
        MODE,
        frequency_hz=np.array(hz),
        damping_ratio=np.full(3, damping),
        frequency_std_hz=np.full(3, std),
    )
    assert mode.moved_far is far


@pytest.mark.parametrize(
    ("dependent", "p", "far", "clear"),
    [
        (True, 1e-3, True, True),
        (True, 1e-3, False, False),
        (True, 1e-9, False, True),
        (False, 0.3, True, False),
    ],
)
def test_no_doubt_needs_a_probability_or_a_mode_that_moves_far(
    dependent: bool, p: float, far: bool, clear: bool
) -> None:
    mode = MODE if far else replace(MODE, frequency_hz=np.full(3, 76.7))
    study = LevelStudy(
        levels=(),
        inputs=(),
        modes=(mode,),
        decays=(),
        verdicts=(),
        level_dependent=dependent,
        p_value=p,
        summary="",
    )
    assert study.clearly_level_dependent is clear
