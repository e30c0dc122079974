"""Two random shakers on a rig with exactly repeated modes: all of them are found, as accurately as with a hammer."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from bench import ema as command

import ema_pipeline as ema

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
if not BENCHMARKS.is_dir():
    pytest.skip(
        "benchmarks are not at hand (an installed package does not hold them)", allow_module_level=True
    )
sys.path.insert(0, str(BENCHMARKS))
import shaker_study as study  # noqa: E402


def _modes(folder: Path) -> ema.Modes:
    return ema.identify(ema.read(folder).frfs())


@pytest.mark.slow
def test_repeated_modes_of_two_shakers_are_found_as_with_a_hammer(tmp_path: Path) -> None:
    rig, random = study.pairs(), np.random.default_rng(0)
    study.write_shakers(tmp_path / "shakers", rig, random)
    study.write_hammer(tmp_path / "hammer", rig, random)
    errors = []
    for name in ("shakers", "hammer"):
        modes = _modes(tmp_path / name)
        assert len(modes.frequency_hz) == 6
        far = np.abs(modes.frequency_hz - rig.frequency_hz)
        assert np.all(far < 5 * modes.frequency_std_hz)
        assert np.all(np.abs(modes.damping_ratio - rig.ratio) < 5 * modes.damping_std)
        errors.append(np.max(modes.frequency_std_hz / rig.frequency_hz))
    assert errors[0] < 3 * errors[1]


def test_more_modes_than_records_are_simulated_with_are_identified_and_not_diagnosed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With one of the modes left out, its response would be told as missing physics."""
    study.write_shakers(tmp_path / "raw", study.ring(), np.random.default_rng(11))
    code, text, _ = command(capsys, "run", tmp_path / "raw", "--out", tmp_path / "out")
    assert code == 0
    assert "6 modes from 22.51 to 45.02 Hz; no model was named" in text
    told = " ".join(text.split())
    assert "Nothing was diagnosed: 6 modes take part in the response" in told
    code, _, err = command(capsys, "diagnose", tmp_path / "out")
    assert code == 1
    assert "nothing was diagnosed: 6 modes take part" in err
