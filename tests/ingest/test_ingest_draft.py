"""Drafted descriptions: what the files tell is filled in, what they do not stops the run."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from ingest_example import RATE, hammer_test, write_csv, write_uff
from scipy.io import wavfile

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest import (
    draft_description,
    load_record,
    load_records,
    read_campaign,
    read_description,
    write_drafts,
)

DATA = hammer_test()
SI = {"hammer [N]": DATA["hammer"], "sun_y [m/s^2]": DATA["tip"]}


def test_files_that_tell_everything_need_no_editing(tmp_path: Path) -> None:
    for name in ("sun_y_1.csv", "sun_y_2.csv"):
        write_csv(tmp_path / name, SI)
    assert write_drafts(tmp_path) == [tmp_path / "test.toml"]
    test = read_description(tmp_path)
    assert test.force.name == "hammer"
    assert test.responses[0].dof == Dof("sun", "y")
    assert [r.impact for r in test.records] == [Dof("sun", "y")] * 2
    assert test.sample_rate_hz == RATE
    assert len(list(load_records(test))) == 2


def test_the_three_frame_records_run_without_editing_as_one_repeated_measurement(
    test_data: Path, tmp_path: Path
) -> None:
    for packed in (test_data / "realdata" / "frame3_hammer").glob("*.gz"):
        (tmp_path / packed.stem).write_bytes(gzip.decompress(packed.read_bytes()))
    write_drafts(tmp_path)
    test = read_campaign(tmp_path).tests[0]
    assert test.force.name == "CH8"
    assert test.force.uncalibrated
    assert "unscaled" in (tmp_path / "test.toml").read_text()
    records = list(load_records(test))
    assert [r.impact for r in records] == [Dof("hit1", "z")] * 3
    assert not any(r.force_calibrated for r in records)
    assert records[0].responses[0, 0] == pytest.approx(-0.01778343902)  # cm/s² to m/s²


def test_numbered_points_are_not_averaged_with_each_other(tmp_path: Path) -> None:
    for name in ("point01.csv", "point02.csv", "run3.csv"):
        write_csv(tmp_path / name, SI)
    write_drafts(tmp_path)
    assert len({r.impact for r in read_description(tmp_path).records}) == 3


def test_counted_sets_of_one_name_are_repetitions_of_one_blow(tmp_path: Path) -> None:
    for name in ("ham_set1_nomass.csv", "ham_set2_no_mass.csv", "ham_set1_mass.csv"):
        write_csv(tmp_path / name, SI)
    write_drafts(tmp_path)
    impacts = {r.file: r.impact for r in read_description(tmp_path).records}
    assert impacts["ham_set1_nomass.csv"] == impacts["ham_set2_no_mass.csv"]
    assert impacts["ham_set1_mass.csv"] != impacts["ham_set1_nomass.csv"]


def test_a_unit_that_no_file_tells_stops_the_run(tmp_path: Path) -> None:
    write_csv(tmp_path / "hit1.csv", DATA)
    write_drafts(tmp_path)
    with pytest.raises(EmaError, match=r"test\.toml: channel 'hammer': unit is not filled in"):
        read_campaign(tmp_path)


def test_volts_throughout_stop_the_run_for_want_of_sensitivities(tmp_path: Path) -> None:
    write_uff(tmp_path / "hit1.uff", DATA, binary=True, ordinate_axis_units_lab="V")
    write_drafts(tmp_path)
    test = read_description(tmp_path)
    with pytest.raises(EmaError, match=r"hit1\.uff: channel 'hammer': the file is in 'V'"):
        load_record(test, test.records[0])


def test_the_hammer_is_known_by_its_pulse_where_no_name_tells(tmp_path: Path) -> None:
    wavfile.write(
        tmp_path / "a.wav", int(RATE), np.column_stack([DATA["tip"], DATA["hammer"]]).astype(np.float32)
    )
    text = draft_description(tmp_path)
    force = next(block for block in text.split("[[channels]]") if 'quantity = "force"' in block)
    assert 'name = "ch2"' in force


def test_node_and_direction_of_uff_become_dofs(tmp_path: Path) -> None:
    write_uff(tmp_path / "a.uff", {"hammer": DATA["hammer"], "acc": DATA["tip"]}, binary=False)
    assert 'dof = "2.z"' in draft_description(tmp_path)


def test_each_sub_folder_gets_its_own_draft_and_none_is_overwritten(tmp_path: Path) -> None:
    for sub in ("no_ring", "with_ring"):
        (tmp_path / sub).mkdir()
        write_csv(tmp_path / sub / "sun_y.csv", SI)
    (tmp_path / "photos").mkdir()
    assert write_drafts(tmp_path) == [tmp_path / s / "test.toml" for s in ("no_ring", "with_ring")]
    assert [t.configuration for t in read_campaign(tmp_path).tests] == ["no_ring", "with_ring"]
    (tmp_path / "no_ring" / "test.toml").write_text("# mine")
    (tmp_path / "with_ring" / "test.toml").unlink()
    assert write_drafts(tmp_path) == [tmp_path / "with_ring" / "test.toml"]
    with pytest.raises(EmaError, match="exists already and is kept"):
        write_drafts(tmp_path)
    assert (tmp_path / "no_ring" / "test.toml").read_text() == "# mine"
    with pytest.raises(EmaError, match="exists already"):
        draft_description(tmp_path / "no_ring")


def test_a_damaged_file_is_mentioned_and_the_rest_is_drafted(tmp_path: Path) -> None:
    write_csv(tmp_path / "sun_y_1.csv", SI)
    whole = (tmp_path / "sun_y_1.csv").read_text().splitlines()
    (tmp_path / "sun_y_2.csv").write_text("\n".join([*whole[:500], "1,oops,3", *whole[500:]]))
    text = draft_description(tmp_path)
    assert "# CHECK: not drafted:" in text
    assert "sun_y_2.csv" in text
    write_drafts(tmp_path)
    assert [r.file for r in read_description(tmp_path).records] == ["sun_y_1.csv"]


def test_a_folder_without_record_files_says_so(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing here\n")
    with pytest.raises(EmaError, match="no record files"):
        write_drafts(tmp_path)
    with pytest.raises(EmaError, match="there is no such folder"):
        write_drafts(tmp_path / "gone")


def test_awkward_names_survive_the_draft(tmp_path: Path) -> None:
    write_csv(tmp_path / 'a "b".csv', {"hammer [N]": DATA["hammer"], "Träger oben [g]": DATA["tip"]})
    write_drafts(tmp_path)
    test = read_description(tmp_path)
    assert test.responses[0].name == "Träger oben"
    assert load_record(test, test.records[0]).channels[0].name == "Träger oben"
