"""Modal identification of real measurements and independently simulated rigs, from raw folder to modes."""

from __future__ import annotations

import contextlib
import gzip
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ema_pipeline import cli
from ema_pipeline.ingest.draft import write_drafts
from ema_pipeline.modal.types import ModalModel, Mode
from ema_pipeline.store import Store

AIRCRAFT_HZ = [
    18.84,
    40.12,
    87.85,
    89.65,
    97.07,
    105.20,
    118.01,
    125.21,
    125.58,
    129.95,
    135.28,
    143.37,
    166.27,
]
"""Published for the structure by a commercial polyreference estimator."""

STAGES = 'stages = ["ingest", "hits", "frf", "modal"]\n'


def identified(
    raw: Path, out: Path, *arguments: str, configuration: str = "default", settings: str = ""
) -> ModalModel:
    """Modes that ``ema run`` finds in a raw folder."""
    out.mkdir(exist_ok=True)
    pipeline = out / "pipeline.toml"
    pipeline.write_text(STAGES + settings, encoding="utf-8")
    before = sys.argv
    sys.argv = ["ema", "run", str(raw), "--out", str(out / "results"), "-p", str(pipeline), "-q", *arguments]
    try:
        with contextlib.suppress(SystemExit):
            cli.main()
    finally:
        sys.argv = before
    return Store(out / "results").load("modal", configuration, "modal", ModalModel)


def near(model: ModalModel, frequency_hz: float) -> Mode:
    """The mode nearest to a frequency."""
    return min(model.modes, key=lambda m: abs(m.frequency_hz - frequency_hz))


def frequencies(model: ModalModel) -> list[float]:
    return [m.frequency_hz for m in model.modes]


@pytest.mark.slow
def test_all_published_modes_of_the_aircraft_are_found_from_single_hits_and_no_others(
    test_data: Path, tmp_path: Path
) -> None:
    model = identified(test_data / "realdata" / "aircraft_roving_hammer", tmp_path)
    # the mode published at 97.07 Hz sits at 97.53 Hz in this campaign
    expected = [97.53 if f == 97.07 else f for f in AIRCRAFT_HZ]
    assert frequencies(model) == pytest.approx(expected, rel=3e-3)
    assert not model.scaled  # the sensors sit at points that were not hit


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        pytest.param("", id="default"),
        pytest.param("[modal.identify]\nmax_order = 80\n", id="order 80"),
    ],
)
def test_a_mode_that_softens_by_its_own_width_is_kept_and_intervals_hold_what_the_peak_shows(
    test_data: Path, tmp_path: Path, settings: str
) -> None:
    model = identified(test_data / "realdata" / "aircraft_second_campaign", tmp_path, settings=settings)
    assert frequencies(model) == pytest.approx(AIRCRAFT_HZ, rel=3e-3)
    softening = near(model, 105.2)
    assert 105.15 < softening.frequency_hz < 105.35
    assert any("moves" in flag for flag in softening.flags)
    narrow = near(model, 97.1)
    assert abs(narrow.damping_ratio - 0.00099) < 2 * narrow.damping_std < 0.0006
    first = near(model, 40.1)
    assert abs(first.frequency_hz - 40.155) < 2 * first.frequency_std_hz
    assert abs(first.damping_ratio - 0.00265) < 2 * first.damping_std


def test_one_hit_with_one_response_shows_its_plain_peaks(test_data: Path, tmp_path: Path) -> None:
    model = identified(test_data / "realdata" / "tool_holder", tmp_path)
    for expected in (1074.0, 1961.0, 2617.0):  # by five receptances, ours has one
        mode = near(model, expected)
        assert abs(mode.frequency_hz - expected) < 0.03 * expected
        assert abs(mode.frequency_hz - expected) < 2 * mode.frequency_std_hz
    assert len(model.modes) == 4  # the peak at 2745 Hz is plain, and no peak is left without a mode
    last = model.modes[-1]
    assert 2690 < last.frequency_hz < 2760
    assert abs(last.frequency_hz - 2740) < 2 * last.frequency_std_hz


def test_modes_of_five_real_hits_agree_with_a_common_denominator_fit(test_data: Path, tmp_path: Path) -> None:
    model = identified(test_data / "realdata" / "five_hits_25600hz", tmp_path)
    for expected in (810.2, 900.0, 1518.1, 2640.2, 3668.7):
        assert near(model, expected).frequency_hz == pytest.approx(expected, rel=1e-3)


def test_three_modes_of_a_frame_and_no_others(test_data: Path, tmp_path: Path) -> None:
    raw = tmp_path / "frame"
    raw.mkdir()
    for packed in (test_data / "realdata" / "frame3_hammer").glob("*.gz"):
        (raw / packed.stem).write_bytes(gzip.decompress(packed.read_bytes()))
    write_drafts(raw)
    model = identified(raw, tmp_path / "out")
    assert frequencies(model) == pytest.approx([2.17, 6.89, 13.263], rel=8e-3)


@pytest.fixture(scope="module", params=["i2", "i3"])
def imperfect(
    request: pytest.FixtureRequest, test_data: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Store, str]:
    """Results of an imperfect rig with two planets, run up to its comparison with the model, and the screen."""
    out = tmp_path_factory.mktemp("imperfect") / "out"
    stages = 'stages=["ingest", "hits", "frf", "modal", "ladder", "fit", "correlate"]'
    raw = test_data / "imperfect" / request.param
    command = ["run", str(raw), "--rig", "planetary", "--out", str(out), "--set", stages]
    done = CliRunner().invoke(cli.app, command)
    assert done.exit_code == 0, done.output
    return Store(out), done.output


@pytest.mark.slow
@pytest.mark.parametrize(("configuration", "count"), [("no_ring", 10), ("with_ring", 14)])
def test_drift_from_hit_to_hit_makes_no_twins(
    imperfect: tuple[Store, str], configuration: str, count: int
) -> None:
    # two planets: 12 modes, two of them rigid, without the ring; 15 modes, one of them rigid, with it
    model = imperfect[0].load("modal", configuration, "modal", ModalModel)
    assert len(model.modes) == count
    for mode in model.modes:  # 0.15 % in eight or ten hits
        assert 2e-4 < mode.frequency_std_hz / mode.frequency_hz < 3e-3


@pytest.mark.slow
def test_imperfect_planetary_rigs_raise_no_suspicion_of_a_sensor(imperfect: tuple[Store, str]) -> None:
    screen = imperfect[1]
    assert "damping, %" in screen
    assert "sensor is suspected" not in screen


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
    test_data: Path, tmp_path: Path, configuration: str, expected: list[float]
) -> None:
    raw = test_data / "blind" / "p1-healthy" / configuration
    model = identified(raw, tmp_path, "--rig", "planetary", configuration=configuration)
    found = np.array(frequencies(model))
    below = found < 1.002 * expected[-1]
    assert found[below] == pytest.approx(expected, rel=3e-3)
    for mode, inside in zip(model.modes, below, strict=True):
        assert not inside or abs(mode.damping_ratio - 0.01) < max(3 * mode.damping_std, 1e-4)
