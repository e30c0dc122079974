"""What looks like a mode and is none: mains hum, and the sentences and the screen that name it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from accepted_hits import accepted
from click.testing import Result
from simulate_modal import Hits, TrueSystem, records_of, simulate_hits, write_raw_folder
from typer.testing import CliRunner

from ema_pipeline import cli
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.records import Record
from ema_pipeline.modal.drift.plain import plain_peaks
from ema_pipeline.modal.drift.windows import MAX_PEAKS
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.left_out import MOST, sentences
from ema_pipeline.modal.mains_hum import REASON, without_hum
from ema_pipeline.modal.peaks import NO_PEAKS, KnownPeaks
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.types import LeftOut, ModalModel

SYSTEM = TrueSystem(np.array([82.0, 171.0, 263.0]), np.array([0.006, 0.005, 0.004]), np.ones((3, 1)))


def with_hum(
    mains_hz: float, share: float = 0.06, system: TrueSystem = SYSTEM, record_s: float = 4.0, n_hits: int = 3
) -> list[Record]:
    """Hits with 50 or 60 Hz and its third harmonic on the response, in another phase in every hit."""
    rng = np.random.default_rng(2)
    made = simulate_hits(
        system,
        [0],
        [0],
        f_max=400,
        record_s=record_s,
        n_hits=n_hits,
        force_noise=2e-3,
        response_noise=2e-3,
        rng=rng,
    )
    time = np.arange(made.force.shape[-1]) / made.sample_rate_hz
    size = share * np.sqrt(np.mean(made.responses**2))
    phase = rng.uniform(0, 6, (n_hits, 2))
    tones = np.array([[np.sin(2 * np.pi * mains_hz * k * time + p[k // 2]) for k in (1, 3)] for p in phase])
    responses = made.responses + size * tones.sum(axis=1)[None, :, None]
    return records_of(Hits(made.force, responses, *_rest(made)), [0], [0])


def _rest(made: Hits) -> tuple[float, int, float, np.ndarray]:
    return made.sample_rate_hz, made.pretrigger, made.force_noise, made.response_noise


def measured(records: list[Record]) -> FrfSet:
    return estimate_frfs(accepted(records))


def judged(
    records: list[Record], frequency_hz: float, decay: float, asked: KnownPeaks = NO_PEAKS
) -> tuple[ModalModel, ModalModel]:
    """A model with a pole that the fit might have put there as its second, and the same without hum."""
    hits = accepted(records)
    frfs = estimate_frfs(hits)
    modal = identify(frfs, ModalSettings())
    pole = -decay + 2j * np.pi * frequency_hz
    tone = replace(modal.modes[0], frequency_hz=frequency_hz, damping_ratio=decay / abs(pole), pole=pole)
    made = replace(modal, modes=(modal.modes[0], tone, *modal.modes[1:]))
    return made, without_hum(made, lambda: hits, frfs, asked)


@pytest.mark.parametrize("decay", [0.1, 2.0], ids=["goes on", "seems to decay"])
def test_a_pole_that_follows_mains_hum_is_named_and_no_mode(decay: float) -> None:
    modal, fewer = judged(with_hum(50.0), 150.01, decay)
    assert fewer.modes == (modal.modes[0], *modal.modes[2:])
    assert [e.frequency_hz for e in fewer.left_out if e.reason == REASON] == [150.01]
    assert any("hum" in note and "150.01 Hz" in note for note in fewer.notes)


@pytest.mark.parametrize("mains_hz", [49.9938, 50.0062, 50.0188])
def test_strong_hum_between_two_round_frequencies_is_no_mode(mains_hz: float) -> None:
    modal, fewer = judged(with_hum(mains_hz, 1.0), 3 * mains_hz, 0.1)
    assert fewer.modes == (modal.modes[0], *modal.modes[2:])


def test_hum_of_single_hits_that_start_at_the_blow_hardly_decays() -> None:
    records = [
        replace(r, force=r.force[18:], responses=np.asarray(r.responses)[:, 18:])
        for r in with_hum(50.0, n_hits=1)
    ]
    modal, fewer = judged(records, 150.01, 0.1)
    assert fewer.modes == (modal.modes[0], *modal.modes[2:])


def test_a_mode_beside_the_mains_is_no_hum() -> None:
    kept, same = judged(with_hum(50.0), 151.0, 0.1)
    assert same is kept


def test_a_heavily_damped_mode_whose_half_width_reaches_hum_is_none() -> None:
    kept, same = judged(with_hum(50.0, 1.0), 142.0, 0.1 * 2 * np.pi * 142.0)
    assert same is kept


def test_a_mode_that_the_user_includes_is_no_hum() -> None:
    asked = KnownPeaks(np.array([-0.1 + 2j * np.pi * 150.01]), np.array([1.0]), np.ones((1, 2)))
    kept, same = judged(with_hum(50.0), 150.01, 0.1, asked)
    assert same is kept


@pytest.mark.parametrize(
    ("frequency_hz", "mains_hz"), [(50.01, 50.0), (60.02, 60.01), (100.03, 50.01), (150.0, 50.0)]
)
@pytest.mark.parametrize(("share", "n_hits"), [(0.0, 1), (0.02, 1), (0.0, 3), (0.02, 3), (0.1, 3)])
def test_modes_at_multiples_of_the_mains_stay(
    frequency_hz: float, mains_hz: float, share: float, n_hits: int
) -> None:
    """Of a mode with 0.1 % more than half is left at the end of these records."""
    system = TrueSystem(np.array([frequency_hz, 213.0]), np.array([0.001, 0.005]), np.ones((2, 1)))
    hits = accepted(with_hum(mains_hz, share, system, record_s=0.8, n_hits=n_hits))
    frfs = estimate_frfs(hits)
    modal = identify(frfs, ModalSettings())
    assert any(abs(m.frequency_hz - frequency_hz) < 0.5 for m in modal.modes)
    kept = without_hum(modal, lambda: hits, frfs, NO_PEAKS)
    assert any(abs(m.frequency_hz - frequency_hz) < 0.5 for m in kept.modes)


@pytest.mark.parametrize("mains_hz", [50.0, 60.0])
def test_hum_makes_no_modes_and_the_screen_says_what_was_left_out(tmp_path: Path, mains_hz: float) -> None:
    write_raw_folder(tmp_path / "raw", with_hum(mains_hz))
    command = ["run", str(tmp_path / "raw"), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(cli.app, command)
    assert done.exit_code == 0, done.output
    text = " ".join(done.output.split())
    assert "3 modes from 82" in text
    assert "3 modes, 1 candidate left out" in text


def test_what_is_left_out_is_named_to_the_last() -> None:
    entries = tuple(LeftOut(100.0 + k, 0.01, "peak", "why") for k in range(MOST + 3))
    told = sentences(entries)
    assert len(told) == MOST + 1
    for entry in entries:
        assert any(f"{entry.frequency_hz:.5g}" in sentence for sentence in told)
    assert len(sentences(entries[:MOST])) == MOST


def test_every_plain_peak_is_held_against_the_list_however_many_there_are() -> None:
    rng = np.random.default_rng(6)
    n = MAX_PEAKS + 12
    frequency = np.linspace(40, 760, n)
    system = TrueSystem(frequency, np.full(n, 0.002), 1 + 0.5 * rng.uniform(size=(n, 2)))
    made = simulate_hits(
        system, [0, 1], [0], f_max=800, record_s=6.0, n_hits=1, force_noise=1e-3, response_noise=1e-3, rng=rng
    )
    frfs = measured(records_of(made, [0, 1], [0]))
    found = np.sort(plain_peaks(frfs, (20.0, 780.0)).poles.imag) / (2 * np.pi)
    assert len(found) > MAX_PEAKS
    assert all(np.abs(frequency - f).min() < 0.3 for f in found)


def run_with_window(folder: Path, stated: str) -> Result:
    """The three modes, which decay by 3.1, 5.4 and 6.6 rad/s, in records that no window was applied to."""
    rng = np.random.default_rng(2)
    made = simulate_hits(
        SYSTEM, [0], [0], f_max=400, record_s=4.0, n_hits=3, force_noise=2e-3, response_noise=2e-3, rng=rng
    )
    write_raw_folder(folder / "raw", records_of(made, [0], [0]))
    file = next((folder / "raw").rglob("test.toml"))
    file.write_text(f"exponential_window_rad_s = {stated}\n{file.read_text()}")
    return CliRunner().invoke(cli.app, ["run", str(folder / "raw"), "--out", str(folder / "out")])


def test_a_mode_that_grows_without_the_stated_window_is_left_out_with_a_caution(tmp_path: Path) -> None:
    done = run_with_window(tmp_path, "4.0")
    assert done.exit_code == 0, done.output
    text = " ".join(done.output.split())
    assert "2 modes from 171" in text
    assert "! left out at 8" in text
    assert (
        "its damping is negative once the exponential window is taken off; correct exponential_window" in text
    )


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ("10.0", r"3 of 3 modes have negative damping .*10 rad/s is taken off.*test\.toml, 0 if none"),
        (
            "1e300",
            r"test\.toml: exponential_window_rad_s = 1e\+300: such a window leaves nothing .* at its end",
        ),
    ],
)
def test_a_window_that_cannot_have_been_applied_ends_the_run(tmp_path: Path, stated: str, words: str) -> None:
    done = run_with_window(tmp_path, stated)
    assert isinstance(done.exception, EmaError)
    assert re.search(words, str(done.exception)), done.exception
