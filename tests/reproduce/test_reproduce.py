"""The sources' numbers, computed anew: what agrees, what differs, and that the page says so."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ema_pipeline.errors import EmaError
from ema_pipeline.reproduce import Entry, Reproduction, Table, markdown, reproduce, terminal_text
from ema_pipeline.reproduce.backlash import SWEEPS, backlash_levels, contact_share, described_resonance
from ema_pipeline.reproduce.gearbox import recover_crack
from ema_pipeline.reproduce.text import difference, number
from ema_pipeline.rigs import load_rig

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(scope="module")
def planetary(tmp_path_factory: pytest.TempPathFactory) -> Reproduction:
    return reproduce("planetary", tmp_path_factory.mktemp("planetary"))


@pytest.fixture(scope="module")
def gearbox() -> Reproduction:
    return reproduce("gearbox")


@pytest.fixture(scope="module")
def isolator() -> Reproduction:
    return reproduce("isolator")


def entries(reproduction: Reproduction, title: str) -> dict[str, Entry]:
    table = next(t for t in reproduction.tables if title in t.title)
    return {e.item: e for e in table.entries}


def test_lin_and_parkers_table_is_met_to_a_tenth_of_a_hertz(planetary: Reproduction) -> None:
    table = entries(planetary, "Check of the assembly")
    assert len(table) == 12
    for entry in table.values():
        assert abs(entry.value - (entry.printed or 0.0)) < 0.06
        assert entry.remark == ""  # multiplicities as printed


def test_ring_bearing_is_found_as_the_parameter_that_cannot_be_meant(planetary: Reproduction) -> None:
    table = entries(planetary, "Which printed parameter")
    assert set(table) == {"ring mass", "ring inertia", "ring bearing stiffness", "ring torsional stiffness"}
    assert table["ring bearing stiffness"].value == pytest.approx(1.64e6, rel=0.02)
    assert "met" in table["ring bearing stiffness"].remark
    assert "cannot" in table["ring inertia"].remark
    damping = entries(planetary, "Damping coefficients")
    assert damping["bearing of the ring"].printed == pytest.approx(
        2 * 0.01 * np.sqrt(1.647e6 * 4.30), rel=1e-3
    )
    assert damping["torsion of the ring"].value == pytest.approx(795, abs=1)


def test_three_modes_give_no_estimate_and_four_give_another_one_than_printed(
    planetary: Reproduction,
) -> None:
    table = entries(planetary, "minimum of the error function")
    assert np.isnan(table["sun-planet, 3 modes"].value)
    assert "flat" in table["sun-planet, 3 modes"].remark
    assert table["sun-planet, 4 modes"].value == pytest.approx(5.5e6, rel=0.02)
    assert 1.5e6 < table["ring-planet, 4 modes"].value < 1.9e6


def test_misfit_at_519_and_712_hz_is_shown_not_hidden(planetary: Reproduction) -> None:
    table = entries(planetary, "Case 2")
    assert abs(table["measured 515 Hz"].difference or 0.0) > 0.3
    assert "no reading" in table["measured 1117 Hz"].remark


def test_figures_and_text_are_written(planetary: Reproduction, tmp_path: Path) -> None:
    reproduce("planetary", tmp_path)
    assert {p.stem for p in tmp_path.glob("*.png")} == set(planetary.figures) == set(planetary.captions)
    text = (tmp_path / "planetary.txt").read_text(encoding="utf-8")
    assert text == terminal_text(planetary)
    assert max(map(len, text.splitlines()[2:])) <= 112


def test_printed_energies_give_the_negative_of_the_printed_damper(isolator: Reproduction) -> None:
    entry = entries(isolator, "Energy per cycle")["c from the printed energies"]
    assert entry.value == pytest.approx(-38.1, abs=0.1)
    assert entry.printed == 39.69
    assert "negative" in entry.remark


def test_isolator_parameters_come_back_from_simulated_loops(isolator: Reproduction) -> None:
    table = entries(isolator, "Parameters")
    for name in ("stiffness", "quadratic stiffness", "viscous damping", "k_w·ρ"):
        assert abs(table[name].difference or 1.0) < 0.03, name
    assert abs(table["hysteresis sigma"].difference or 1.0) < 0.10
    assert "not distinguishable from zero" in table["cubic stiffness"].remark


def test_cracked_mesh_is_recovered_within_five_percent_from_raw_hits(gearbox: Reproduction) -> None:
    entry = entries(gearbox, "Stiffness of the cracked mesh")["cracked sun-planet1 mesh"]
    assert abs(entry.difference or 1.0) < 0.05
    true, value, std = recover_crack(load_rig("gearbox"), seed=2)
    assert abs(value / true - 1) < 0.05
    assert abs(value - true) < 3 * std


def test_crack_parts_one_planet_mode_and_leaves_the_other(gearbox: Reproduction) -> None:
    table = entries(gearbox, "Natural frequencies")
    assert table["healthy, mode 3"].value == pytest.approx(table["healthy, mode 4"].value, abs=1e-6)
    assert table["cracked, mode 3"].value < table["healthy, mode 3"].value - 50.0
    assert table["cracked, mode 4"].value == pytest.approx(table["healthy, mode 4"].value, abs=1e-3)
    healthy, cracked = (gearbox.figures["gearbox_frf"].axes[k] for k in (0, 2))
    assert (healthy.get_title(), cracked.get_title()) == ("healthy", "one mesh cracked")
    assert "sun.u, healthy" in [line.get_label() for line in cracked.lines]


def test_resonance_of_a_parting_gearbox_falls_as_its_describing_function_says() -> None:
    rig = load_rig("gearbox")
    second, _ = SWEEPS
    levels = backlash_levels(rig, replace(second, forces_n=(2.0, 15.0)))
    found = [float(level.frequency_hz[level.resonance]) for level in levels]
    described = [described_resonance(rig, second.mode, level) for level in levels]
    assert described[0] == pytest.approx(1822.8, abs=0.1)  # nothing parts: the linear mode
    assert found[1] < found[0] - 100.0
    # Lines are 4 Hz apart; harmonic balance keeps five harmonics, the describing function one.
    np.testing.assert_allclose(found, described, rtol=0.01)


def test_share_of_contact_has_its_limits() -> None:
    assert contact_share(2e-6, 0.0, 1e-6) == 1.0  # never parts
    assert contact_share(2e-6, -4e-6, 1e-6) == 0.0  # never touches
    assert contact_share(0.0, 0.0, 1e-6) == pytest.approx(0.5)  # half of the cycle


def test_unknown_source_is_refused_with_a_hint() -> None:
    with pytest.raises(EmaError, match="did you mean 'gearbox'"):
        reproduce("gearbx")


def test_numbers_and_differences_are_short() -> None:
    assert number(1475.71, "Hz") == "1475.7"
    assert number(None) == "–"
    assert number(float("nan")) == "none"
    assert difference(Entry("x", 2.0, 2.1, "m")) == "+5.0 %"
    assert difference(Entry("x", 1.0, 10.0, "m")) == "×10"
    assert difference(Entry("x", None, 10.0, "m")) == ""
    table = Table("t", "s", (Entry("x", 1.0, 2.0, "1", "why " * 60),), ("remark",))
    text = terminal_text(Reproduction("n", "T", "S", (table,), {}, {}))
    assert "* remark" in text


@pytest.mark.parametrize("name", ["planetary", "gearbox", "isolator"])
def test_documented_page_holds_what_comes_out(name: str, request: pytest.FixtureRequest) -> None:
    page = (DOCS / "seeds.md").read_text(encoding="utf-8")
    computed = markdown(request.getfixturevalue(name))
    rows = [line for line in computed.splitlines() if line.startswith("|")]
    assert rows
    printed = [line for line in page.splitlines() if line.startswith("|")]
    missing = [row for row in rows if not any(_alike(row, line) for line in printed)]
    assert not missing, missing[:3]
    for figure in re.findall(r"\((figures/[\w.]+)\)", computed):
        assert (DOCS / figure).stat().st_size < 100_000


NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def _alike(row: str, line: str) -> bool:
    """Equal but for what rounding changes between machines: 4 % of a number, 0.35 of a percentage.

    A value with its standard deviation may differ by a tenth of that, and both come from a fit that stops near the
    optimum: 10 % of them.
    """
    if NUMBER.sub("0", row) != NUMBER.sub("0", line):
        return False
    found, printed = (np.array([float(n) for n in NUMBER.findall(text)]) for text in (row, line))
    share = 0.1 if "±" in line else 0.04
    return bool(np.all(np.abs(found - printed) <= np.maximum(share * np.abs(printed), 0.35)))
