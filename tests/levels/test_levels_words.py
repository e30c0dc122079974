"""What is said of a mode that moves with the force, from the levels' own FRFs and from single hits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ema_pipeline.levels.sentences import move_text
from ema_pipeline.levels.types import ForceLevel, LevelStudy, ModeLevels

LEVELS = (ForceLevel(30.0, ()), ForceLevel(100.0, ()), ForceLevel(300.0, ()))
STUDY = LevelStudy(LEVELS, (), (), (), (), True, 1e-9, "")
FALLING = ModeLevels(
    mode=0,
    frequency_hz=np.full(3, 159.6),
    frequency_std_hz=np.full(3, 0.05),
    damping_ratio=np.array([0.0187, 0.0162, 0.0158]),
    damping_std=np.array([0.0003, 0.0003, 0.0003]),
    amplitude_m=np.full((3, 1), 1e-4),
    frequency_p=0.2,
    damping_p=2e-5,
    depends=True,
    trend="damping falls",
    damping_shift=np.array([0.0, -0.001, -0.002]),
    damping_shift_std=np.array([0.0, 3e-4, 3e-4]),
)
SMEARED = replace(FALLING, damping_std=np.array([0.0003, 0.01, 0.01]))


def test_what_the_levels_own_frfs_show_is_said() -> None:
    assert (
        move_text(STUDY, FALLING) == "damping falls with force: 1.87 ± 0.03 → 1.58 ± 0.03 % from 30 to 300 N"
    )


def test_where_these_do_not_show_it_single_hits_tell() -> None:
    assert (
        move_text(STUDY, SMEARED) == "damping falls with force: 1.87 ± 0.03 → 1.67 ± 0.04 % from 30 to 300 N"
    )


@pytest.mark.parametrize("shift", [0.0023, -0.0231, np.nan])
def test_single_hits_that_show_no_such_change_give_no_values(shift: float) -> None:
    """It rises, falls below nothing, or is not known."""
    mode = replace(SMEARED, damping_shift=np.array([0.0, 0.0, shift]))
    assert move_text(STUDY, mode) == "damping falls with force from 30 to 300 N"
