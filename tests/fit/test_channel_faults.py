"""Wrong sensitivities and reversed channels, as a user meets them: the first caution names channel and factor."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench import ema, write_bench
from simulate_modal import frf_set

from ema_pipeline.dof import Dof
from ema_pipeline.fit.channel_faults import suspected_sensitivities
from ema_pipeline.fit.comparison import windowed_accelerance
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.ingest.campaign import read_campaign
from ema_pipeline.ingest.hit_checks import hits_of_test
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.records import HitSamples, cut_hit
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.rigs import load_rig

QUICK = 'stages=["ingest", "hits", "frf", "modal", "ladder", "fit", "correlate"]'
"""Without diagnosis and report, which take longest."""

CAUTION = re.compile(r"^! (\S.*(?:\n  .*)*)", re.MULTILINE)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A healthy test on the user's own rig in a usual laboratory: channels off by 4 %, blows by 8°."""
    return write_bench(tmp_path_factory.mktemp("bench"), imperfection="normal", acceleration_noise=0.02)


Change = Callable[[str], str]
Told = Callable[..., list[str]]


def edited(raw: Path, folder: Path, channel: str, change: Change) -> Path:
    """A copy of a raw folder in which the entry of one channel is changed."""
    copy = folder / "raw"
    shutil.copytree(raw, copy)
    (toml,) = copy.rglob("test.toml")
    head, *entries = toml.read_text(encoding="utf-8").split("[[channels]]")
    assert any(f'name = "{channel}"' in e for e in entries)
    entries = [change(e) if f'name = "{channel}"' in e else e for e in entries]
    toml.write_text("[[channels]]".join([head, *entries]), encoding="utf-8")
    return copy


def scaled(factor: float) -> Change:
    """State a sensitivity that is wrong by a factor."""

    def change(entry: str) -> str:
        return re.sub(
            r"sensitivity_mv = ([\d.]+)", lambda m: f"sensitivity_mv = {float(m[1]) * factor}", entry
        )

    return change


@pytest.fixture
def cautions(bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Told:
    """Runs the test with one channel changed; returns the cautions on the screen."""

    def told(channel: str = "", change: Change = str, model: bool = True) -> list[str]:
        raw = edited(bench, tmp_path, channel, change) if channel else bench
        if not model:
            (raw / "rig.toml").unlink()
        rig = ("--rig", bench.parent / "bench.toml") if model else ()
        code, out, err = ema(capsys, "run", raw, *rig, "--out", tmp_path / "out", "--set", QUICK)
        assert code == 0, err
        return [re.sub(r"\s+", " ", found) for found in CAUTION.findall(out)]

    return told


@pytest.mark.parametrize(
    ("channel", "stated", "reading"),
    [
        ("m2_x", 9.81, "times too low"),
        ("m2_x", 0.1, "times too high"),
        ("hammer", 10.0, "times too low"),
        ("hammer", 4.448, "times too low"),
    ],
)
def test_a_wrong_sensitivity_is_the_first_caution_with_channel_and_factor(
    cautions: Told, channel: str, stated: float, reading: str
) -> None:
    first = cautions(channel, scaled(stated))[0]
    assert f"channel '{channel}'" in first
    assert reading in first
    assert "look up sensitivity_mv and unit" in first
    found = re.search(r"reads ([\d.]+) times", first)
    assert found is not None
    assert float(found[1]) == pytest.approx(max(stated, 1 / stated), rel=0.2)


def test_a_reversed_channel_is_the_first_caution(cautions: Told) -> None:
    first = cautions("m2_x", lambda entry: entry.replace('dof = "m2.x"', 'dof = "-m2.x"'))[0]
    assert "channel 'm2_x' at m2.x has the opposite sign" in first


def test_channels_that_contradict_each_other_are_named_without_a_model(cautions: Told) -> None:
    first = cautions("m3_x", scaled(9.81), model=False)[0]
    assert "channels 'm1_x' and 'm3_x' contradict each other" in first
    assert "mV/g" in first


def test_a_force_that_no_hammer_makes_is_the_first_caution(cautions: Told) -> None:
    first = cautions("hammer", scaled(1e-3), model=False)[0]
    assert "channel 'hammer' peaks at" in first
    assert "which no impact hammer makes" in first


def test_a_model_that_falls_into_two_parts_is_compared_where_it_has_frfs(bench: Path, tmp_path: Path) -> None:
    text = (bench.parent / "bench.toml").read_text(encoding="utf-8")
    rig = tmp_path / "two_parts.toml"
    rig.write_text(text.replace('between = ["m1.x", "m2.x"]', 'at = "m2.x"'), encoding="utf-8")
    measured = estimate_frfs(hits_in(bench))
    assert not suspected_sensitivities({"default": measured}, {"default": [load_rig(rig).system("default")]})


@pytest.mark.parametrize("coefficient", [1e4, 1e20])
def test_a_damper_that_holds_a_mass_makes_a_poor_model_and_no_fault(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], coefficient: float
) -> None:
    rig = tmp_path / "held.toml"
    text = (bench.parent / "bench.toml").read_text(encoding="utf-8")
    rig.write_text(f'{text}\n[[dampers]]\nat = "m1.x"\nvalue = {coefficient}\n', encoding="utf-8")
    code, out, err = ema(capsys, "run", bench, "--rig", rig, "--out", tmp_path / "out", "--set", QUICK)
    assert code == 0, err
    assert "no model mode within" in out


def three_masses(
    stiffness: np.ndarray, dofs: tuple[str, ...], struck: tuple[int, ...]
) -> tuple[np.ndarray, Callable[[int, np.ndarray], list[str]]]:
    """Exact FRFs of three coordinates of 1 kg, and what is suspected of a channel where one output reads other ones."""
    system = LinearSystem(
        dofs=dofs, mass=np.eye(3), stiffness=stiffness, damping=2e-5 * stiffness,
        structural=np.zeros((3, 3)), modal_damping_ratio=0.0, sensors={},
    )  # fmt: skip
    lines, points = np.arange(1.0, 200.0, 0.25), tuple(map(Dof.parse, dofs))
    blank = frf_set(lines, np.zeros((3, len(struck), len(lines)), complex), range(3), range(len(struck)))
    blank = replace(blank, outputs=points, inputs=tuple(points[i] for i in struck), band_hz=(2.0, 190.0))
    exact = windowed_accelerance(system, blank)

    def suspected(output: int, change: np.ndarray) -> list[str]:
        read = exact.copy()
        read[output] = change
        told = suspected_sensitivities({"all": replace(blank, frf=read)}, {"all": [system]})
        return [f"{c.channel} {c.value:.1f}" for c in told]

    return exact, suspected


def test_a_sensor_that_hardly_moves_its_own_way_may_read_another_one() -> None:
    """A mass that a stiff spring holds in y moves by 3 % of its x: a sensor with 6 % of transverse sensitivity reads
    three times as much."""
    stiffness = np.array([[3e5, -2e5, -1e5], [-2e5, 7e6, 0.0], [-1e5, 0.0, 2e5]])
    exact, suspected = three_masses(stiffness, ("m1.x", "m1.y", "m2.x"), struck=(0, 2))
    assert suspected(1, exact[1] + 0.06 * exact[0]) == []
    assert suspected(0, 5.0 * exact[0]) == ["m1.x 5.0"]
    assert suspected(2, 5.0 * exact[2]) == ["m2.x 5.0"]  # no other sensor at this body


def test_what_oblique_blows_make_where_the_model_hardly_answers_turns_no_channel() -> None:
    """Far smaller than the channel's other FRFs are against the model, and of the other sign; a turned channel is."""
    stiffness = np.array([[3e5, -2e5, 0.0], [-2e5, 3e5, -1e5], [0.0, -1e5, 2e5]])
    exact, suspected = three_masses(stiffness, ("m1.x", "m2.x", "m3.x"), struck=(0, 1, 2))
    assert suspected(2, np.array([[-0.03], [-0.03], [1.0]]) * exact[2]) == []
    assert suspected(2, -exact[2]) == ["m3.x -1.0"]
    assert suspected(2, -5.0 * exact[2]) == ["m3.x 5.0", "m3.x -1.0"]


def hits_in(raw: Path) -> list[HitSamples]:
    """The hits of a test, cut from their records."""
    records = [r for test in read_campaign(raw).tests for r in load_records(test)]
    by_file = {r.file: r for r in records}
    return [cut_hit(by_file[h.file], h) for h in hits_of_test(records)]


def test_a_usual_laboratory_raises_no_suspicion(cautions: Told) -> None:
    assert not [c for c in cautions() if "sensitivity" in c or "opposite sign" in c]


@pytest.mark.parametrize(
    "folder", [pytest.param("blind/p2", marks=pytest.mark.slow), "imperfect/g1004", "imperfect/g1007"]
)
def test_imperfect_rigs_raise_no_suspicion(
    test_data: Path, folder: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if not (test_data / folder).is_dir():
        pytest.skip(f"{test_data / folder} is not there")
    rig = () if "g1" in folder else ("--rig", "planetary")
    out = tmp_path / "out"
    code, text, err = ema(capsys, "run", test_data / folder, *rig, "--out", out, "--set", QUICK)
    assert code == 0, err
    assert "sensor is suspected" not in text
