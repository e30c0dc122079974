"""Test descriptions: what is right is understood, what is wrong gives one line that says where."""

from __future__ import annotations

from pathlib import Path

import pytest
from ingest_example import DESCRIPTION, make_test

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest import read_campaign, read_description

TIP = 'name = "tip"\nquantity = "acceleration"\nunit = "m/s^2"\ndof = "tip.z"'
HAMMER = 'name = "hammer"\nquantity = "force"\nunit = "N"'
RECORD = '[[records]]\nfile = "{file}"\nimpact = "tip.z"'
SECOND = '\n\n[[channels]]\nname = "root"\nquantity = "acceleration"\nunit = "g"\n'


def test_a_description_is_read_with_its_defaults(tmp_path: Path) -> None:
    test = read_description(make_test(tmp_path))
    assert test.kind == "hammer"
    assert test.configuration is None
    assert test.sample_rate_hz == 2048.0
    assert test.force.name == "hammer"
    assert [c.name for c in test.responses] == ["tip"]
    assert test.records[0].impact == Dof("tip", "z")


def test_a_roving_sensor_overrides_its_dof_for_one_record(tmp_path: Path) -> None:
    text = DESCRIPTION.replace('impact = "tip.z"', 'impact = "root.z"\ndofs = { tip = "-root.y" }')
    test = read_description(make_test(tmp_path, text))
    assert test.dof_of(test.responses[0], test.records[0]) == Dof("root", "y", -1)


def test_names_of_bodies_have_letters_of_any_alphabet_and_no_spaces() -> None:
    assert Dof.parse("-Öse.x") == Dof("Öse", "x", -1)
    assert Dof.parse("2nd-stage.u") == Dof("2nd-stage", "u")
    with pytest.raises(EmaError, match=r"'Träger vorn.x' is not of the form .* but no spaces"):
        Dof.parse("Träger vorn.x")


@pytest.mark.parametrize(("band", "right"), [((0.0, 0.5), True), ((-1.0, 5.0), False), ((5.0, 5.0), False)])
def test_a_band_may_begin_at_0_and_has_its_lower_end_first(
    tmp_path: Path, band: tuple[float, float], right: bool
) -> None:
    folder = make_test(tmp_path, f"band_hz = [{band[0]}, {band[1]}]\n" + DESCRIPTION)
    if right:
        assert read_description(folder).band_hz == band
        return
    with pytest.raises(EmaError, match="is no band; give its lower end first"):
        read_description(folder)


def test_a_description_saved_by_a_windows_editor_is_read(tmp_path: Path) -> None:
    folder = make_test(tmp_path)
    text = (folder / "test.toml").read_text()
    (folder / "test.toml").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert read_description(folder).title == "Beam"


WRONG = {
    "unknown key": (
        DESCRIPTION.replace("sample_rate_hz", "sampel_rate_hz"),
        "did you mean 'sample_rate_hz'?",
    ),
    "unknown channel key": (
        DESCRIPTION.replace('dof = "tip.z"', 'dof = "tip.z"\nsensitivity = 10'),
        "did you mean 'sensitivity_mv'?",
    ),
    "misspelt key that must be there": (
        DESCRIPTION.replace("quantity =", "quanity =", 1),
        "unknown key 'channels.0.quanity' of 'hammer' (did you mean 'quantity'?)",
    ),
    "unknown quantity": (DESCRIPTION.replace('"acceleration"', '"accel"'), "quantity"),
    "newer schema": (DESCRIPTION.replace("schema = 1", "schema = 2"), "schema"),
    "unit of another quantity": (
        DESCRIPTION.replace('"m/s^2"', '"m/s"'),
        "channel 'tip': quantity is 'acceleration' but unit 'm/s' is one of velocity",
    ),
    "unknown unit": (DESCRIPTION.replace('"m/s^2"', '"furlong"'), "channel 'tip': unknown unit 'furlong'"),
    "unit not filled in": (
        DESCRIPTION.replace('"m/s^2"', '"?"'),
        "channel 'tip': unit is not filled in",
    ),
    "hammer in volts": (
        DESCRIPTION.replace('"N"', '"V"'),
        "or uncalibrated = true to go on with unscaled FRFs",
    ),
    "response in volts": (DESCRIPTION.replace('"m/s^2"', '"V"'), "channel 'tip': unit 'V' is not a unit of"),
    "uncalibrated response": (
        DESCRIPTION.replace('dof = "tip.z"', 'dof = "tip.z"\nuncalibrated = true'),
        "only a force channel can be uncalibrated",
    ),
    "uncalibrated in newtons": (
        DESCRIPTION.replace('unit = "N"', 'unit = "N"\nuncalibrated = true'),
        "channel 'hammer': uncalibrated = true means volts",
    ),
    "negative calibration": (
        DESCRIPTION.replace('unit = "N"', 'unit = "N"\ncalibration_std = -0.1'),
        "calibration_std = -0.1: give a share from 0 to below 1, e.g. 0.02 for 2 %",
    ),
    "calibration in percent": (
        DESCRIPTION.replace('dof = "tip.z"', 'dof = "tip.z"\ncalibration_std = 2'),
        "calibration_std = 2: give a share",
    ),
    "value of a channel": (
        DESCRIPTION.replace('dof = "tip.z"', 'dof = "tip.z"\ntransverse = 2'),
        'channels.1.transverse = 2: give a share from 0 to below 1, e.g. 0.02 for 2 % (name = "tip")',
    ),
    "point of a record": (
        DESCRIPTION.replace('impact = "tip.z"', 'impact = "tip"'),
        '(file = "hit1.',
    ),
    "transverse in percent": (
        DESCRIPTION.replace('dof = "tip.z"', 'dof = "tip.z"\ntransverse = 3'),
        "transverse = 3: give a share",
    ),
    "zero sensitivity": (
        DESCRIPTION.replace('unit = "N"', 'unit = "N"\nsensitivity_mv = 0'),
        "sensitivity_mv = 0: Input should be greater than 0",
    ),
    "negative sensitivity": (
        DESCRIPTION.replace('unit = "N"', 'unit = "N"\nsensitivity_mv = -2.25'),
        "sensitivity_mv = -2.25",
    ),
    "two full scales": (
        DESCRIPTION.replace('unit = "N"', 'unit = "N"\nfull_scale = 1\nfull_scale_v = 2'),
        "give full_scale or full_scale_v, not both",
    ),
    "same channel twice": (DESCRIPTION + f"\n[[channels]]\n{TIP}\n", "channel 'tip' is described 2 times"),
    "no force": (DESCRIPTION.replace(HAMMER, 'name = "h"\nquantity = "velocity"\nunit = "m/s"\ndof = "a.z"'),
                 'exactly one channel must have quantity = "force"; none has it'),
    "two forces": (
        DESCRIPTION + '\n[[channels]]\nname = "h2"\nquantity = "force"\nunit = "N"\n',
        "hammer, h2 have it",
    ),
    "no response": (DESCRIPTION.replace(f"[[channels]]\n{TIP}", ""), "no response channel"),
    "no channels": ("channels = []\nrecords = []", "no channels"),
    "channels missing": ("title = 'x'\nrecords = []", "key 'channels' is missing"),
    "no records": (
        DESCRIPTION.replace(RECORD, "").replace("schema = 1", "schema = 1\nrecords = []"),
        "no records",
    ),
    "record listed twice": (DESCRIPTION + RECORD, "is listed twice"),
    "record file missing": (
        DESCRIPTION.replace("{file}", "hit11.csv"),
        "there is no such file (did you mean 'hit1.csv'?)",
    ),
    "record outside": (DESCRIPTION.replace("{file}", "../hit1.csv"), "lies outside"),
    "absolute record": (DESCRIPTION.replace("{file}", "/etc/passwd"), "lies outside"),
    "record is a folder": (DESCRIPTION.replace("{file}", "."), "is a folder"),
    "impact missing": (DESCRIPTION.replace('impact = "tip.z"', ""), "impact is missing"),
    "impact misspelt": (DESCRIPTION.replace('impact = "tip.z"', 'impact = "tip"'), "is not of the form"),
    "impact a number": (DESCRIPTION.replace('impact = "tip.z"', "impact = 3"), "a dof is text"),
    "dofs of an unknown channel": (
        DESCRIPTION + 'dofs = { tipp = "a.z" }',
        "dofs names an unknown channel 'tipp' (did you mean 'tip'?)",
    ),
    "dofs of the hammer": (DESCRIPTION + 'dofs = { hammer = "a.z" }', "dofs names the hammer channel"),
    "response without dof": (
        DESCRIPTION.replace('dof = "tip.z"', ""),
        "response channel 'tip' has no dof; add dof",
    ),
    "same dof twice": (
        DESCRIPTION + SECOND + 'dof = "-tip.z"',
        "channels 'tip' and 'root' both measure tip.z",
    ),
    "frequency of a hammer record": (DESCRIPTION + "frequency_hz = 3", 'belong to kind = "hysteresis"'),
    "hysteresis without displacement": (
        DESCRIPTION.replace("schema = 1", 'schema = 1\nkind = "hysteresis"'),
        "needs a channel with quantity 'displacement'",
    ),
    **{
        f"{key} a {kind}": (DESCRIPTION.replace(after, f"{after}\n{key} = {value}"), f"{key} = {shown}: ")
        for kind, value, shown in (("boolean", "true", "true"), ("text", '"2560"', "'2560'"))
        for key, after in (
            ("sensitivity_mv", 'unit = "N"'),
            ("full_scale_v", 'unit = "N"'),
            ("sensor_mass_kg", 'dof = "tip.z"'),
            ("exponential_window_rad_s", "schema = 1"),
        )
    },
    "sample rate a boolean": (
        DESCRIPTION.replace("sample_rate_hz = 2048", "sample_rate_hz = true"),
        "sample_rate_hz = true: Input should be a valid number",
    ),
    "schema a boolean": (DESCRIPTION.replace("schema = 1", "schema = true"), "schema = true: give the number 1"),
    "sensor's mass in grams": (
        DESCRIPTION.replace('dof = "tip.z"', 'dof = "tip.z"\nsensor_mass_kg = 5'),
        "sensor_mass_kg = 5: give the sensor's mass in kg, 0 to 2",
    ),
    "band a number": (
        DESCRIPTION.replace("schema = 1", "schema = 1\nband_hz = 20"),
        "band_hz = 20: Input should be a list in [ ]",
    ),
    "broken TOML": (DESCRIPTION.replace("sample_rate_hz = 2048", "sample_rate_hz = "), "line 4"),
}  # fmt: skip


@pytest.mark.parametrize("case", list(WRONG))
def test_a_wrong_description_gives_one_line_that_names_the_file(tmp_path: Path, case: str) -> None:
    text, expected = WRONG[case]
    make_test(tmp_path)
    (tmp_path / "test.toml").write_text(text.replace("{file}", "hit1.csv"), encoding="utf-8")
    with pytest.raises(EmaError) as caught:
        read_campaign(tmp_path)
    message = str(caught.value)
    assert "test.toml" in message
    assert expected in message
    assert "\n" not in message


def test_a_description_that_is_not_utf_8_names_the_line(tmp_path: Path) -> None:
    folder = make_test(tmp_path)
    text = (folder / "test.toml").read_text().replace("Beam", "Träger")
    (folder / "test.toml").write_bytes(text.encode("latin-1"))
    with pytest.raises(EmaError, match=r"test\.toml: line 3 is not UTF-8 text"):
        read_description(folder)


def test_hysteresis_records_carry_frequency_and_amplitude(tmp_path: Path) -> None:
    text = (
        DESCRIPTION.replace("schema = 1", 'schema = 1\nkind = "hysteresis"')
        .replace('"acceleration"\nunit = "m/s^2"\ndof = "tip.z"', '"displacement"\nunit = "mm"')
        .replace('impact = "tip.z"', "frequency_hz = 1\namplitude_m = 0.02")
    )
    test = read_description(make_test(tmp_path, text))
    assert test.kind == "hysteresis"
    assert (test.records[0].frequency_hz, test.records[0].amplitude_m) == (1.0, 0.02)
    (tmp_path / "test.toml").write_text(text.replace("amplitude_m = 0.02", "").replace("{file}", "hit1.csv"))
    with pytest.raises(EmaError, match="amplitude_m is missing"):
        read_description(tmp_path)


def test_sub_folders_make_a_campaign_and_lend_it_their_names(tmp_path: Path) -> None:
    make_test(tmp_path / "with_ring")
    make_test(tmp_path / "no_ring", DESCRIPTION.replace("schema = 1", 'schema = 1\nrig = "planetary"'))
    (tmp_path / "photos").mkdir()
    (tmp_path / "rig.toml").write_text("")
    campaign = read_campaign(tmp_path)
    assert [t.configuration for t in campaign.tests] == ["no_ring", "with_ring"]
    assert campaign.rig == "planetary"
    assert campaign.rig_file == tmp_path / "rig.toml"


def test_a_rig_file_beside_the_test_description_is_found(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (make_test(tmp_path / name) / "rig.toml").write_text("base = 'planetary'")
    assert read_campaign(tmp_path).rig_file == tmp_path / "a" / "rig.toml"
    (tmp_path / "b" / "rig.toml").write_text("base = 'frame'")
    with pytest.raises(EmaError, match="differ"):
        read_campaign(tmp_path)


def test_two_tests_of_one_configuration_contradict_each_other(tmp_path: Path) -> None:
    text = DESCRIPTION.replace("schema = 1", 'schema = 1\nconfiguration = "no_ring"')
    make_test(tmp_path / "monday", text)
    make_test(tmp_path / "tuesday", text)
    with pytest.raises(EmaError, match="'monday' and 'tuesday' both describe configuration 'no_ring'"):
        read_campaign(tmp_path)


def test_two_rigs_in_one_campaign_contradict_each_other(tmp_path: Path) -> None:
    for rig in ("frame", "planetary"):
        make_test(tmp_path / rig, DESCRIPTION.replace("schema = 1", f'schema = 1\nrig = "{rig}"'))
    with pytest.raises(EmaError, match="different rigs"):
        read_campaign(tmp_path)


def test_descriptions_above_and_below_contradict_each_other(tmp_path: Path) -> None:
    make_test(tmp_path)
    make_test(tmp_path / "sub")
    with pytest.raises(EmaError, match="one description per folder"):
        read_campaign(tmp_path)


def test_a_folder_that_is_missing_empty_or_a_file_says_so(tmp_path: Path) -> None:
    with pytest.raises(EmaError, match="there is no such folder"):
        read_campaign(tmp_path / "gone")
    with pytest.raises(EmaError, match=r"'ema init .*' drafts one"):
        read_campaign(tmp_path)
    file = tmp_path / "x.csv"
    file.write_text("a")
    with pytest.raises(EmaError, match="is a file, not a folder"):
        read_campaign(file)


def test_every_description_of_the_test_data_is_understood(test_data: Path) -> None:
    roots = {p.parent for p in test_data.glob("realdata/*/test.toml")}
    roots |= {p.parent.parent for p in test_data.glob("blind/*/*/test.toml")}
    assert len(roots) >= 9
    for root in roots:
        campaign = read_campaign(root)
        assert all(t.records and t.channels for t in campaign.tests)


@pytest.mark.parametrize("value", ["2025-03-31", "10:00:00"])
def test_dates_in_the_wrong_place_are_shown_as_they_were_written(tmp_path: Path, value: str) -> None:
    folder = make_test(tmp_path, DESCRIPTION.replace('title = "Beam"', f"title = {value}"))
    with pytest.raises(EmaError, match=rf"test\.toml: title = {value}: Input should be a valid string"):
        read_description(folder)
