"""Records: scaled to SI by what is written down, refused where that contradicts itself."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from ingest_example import DESCRIPTION, RATE, hammer_test, make_test, write_csv, write_uff
from numpy.testing import assert_allclose
from scipy.io import wavfile

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest import load_channels, load_record, load_records, read_campaign, read_description
from ema_pipeline.ingest.readers.hdf5 import LONG
from ema_pipeline.ingest.records import Record
from ema_pipeline.ingest.swap import find_swap

DATA = hammer_test()
EXACT = 1e-12
"""Relative; pandas before 3 is off by some last digits when it reads decimal numbers."""


def load(folder: Path) -> Record:
    test = read_description(folder)
    return load_record(test, test.records[0])


def message_of(folder: Path) -> str:
    with pytest.raises(EmaError) as caught:
        list(load_records(read_description(folder)))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_file_in_si_is_taken_as_it_is(tmp_path: Path) -> None:
    record = load(make_test(tmp_path))
    assert record.file == "hit1.csv"
    assert record.impact == Dof("tip", "z")
    assert record.sample_rate_hz == RATE
    assert record.force_calibrated
    assert record.force_full_scale == float("inf")
    assert_allclose(record.force, DATA["hammer"], rtol=EXACT)
    assert_allclose(record.responses, [DATA["tip"]], rtol=EXACT)


@pytest.mark.parametrize(
    ("force_unit", "response_unit", "force_scale", "response_scale"),
    [
        ("lbf", "g", 4.4482216152605, 9.80665),
        ("kN", "cm/s^2", 1e3, 0.01),
        ("mN", "in/s^2", 1e-3, 0.0254),
        ("N", "mm/s^2", 1.0, 1e-3),
    ],
)
def test_engineering_units_are_converted_to_si(
    tmp_path: Path, force_unit: str, response_unit: str, force_scale: float, response_scale: float
) -> None:
    text = DESCRIPTION.replace('"N"', f'"{force_unit}"').replace('"m/s^2"', f'"{response_unit}"')
    record = load(make_test(tmp_path, text))
    assert_allclose(record.force, DATA["hammer"] * force_scale, rtol=EXACT)
    assert_allclose(record.responses[0], DATA["tip"] * response_scale, rtol=EXACT)


def test_volts_are_scaled_by_the_sensitivity_in_millivolts_per_unit(tmp_path: Path) -> None:
    text = DESCRIPTION.replace('unit = "N"', 'unit = "N"\nsensitivity_mv = 2.25\nfull_scale_v = 5')
    text = text.replace('"m/s^2"', '"g"\nsensitivity_mv = 100.0\nfull_scale = 50\nsensor_mass_kg = 0.004')
    folder = make_test(tmp_path, text)
    volts = {"hammer": DATA["hammer"] * 2.25e-3, "tip": DATA["tip"] * 0.1 / 9.80665}
    write_csv(folder / "hit1.csv", volts)
    record = load(folder)
    assert_allclose(record.force, DATA["hammer"], rtol=1e-12)
    assert_allclose(record.responses[0], DATA["tip"], rtol=1e-12)
    assert record.force_full_scale == pytest.approx(5 / 2.25e-3)
    assert record.channels[0].full_scale == pytest.approx(50 * 9.80665)
    assert record.channels[0].sensor_mass_kg == 0.004


def test_millivolts_that_the_file_declares_are_not_taken_for_volts(tmp_path: Path) -> None:
    text = DESCRIPTION.replace('unit = "N"', 'unit = "N"\nsensitivity_mv = 2.25')
    folder = make_test(tmp_path, text)
    write_csv(folder / "hit1.csv", {"hammer [mV]": DATA["hammer"] * 2.25, "tip": DATA["tip"]})
    assert_allclose(load(folder).force, DATA["hammer"], rtol=1e-12)


def test_volts_at_full_scale_are_those_of_the_sensors_unit(tmp_path: Path) -> None:
    """10 V on a channel of 100 mV/g are 100 g."""
    text = DESCRIPTION.replace('"m/s^2"', '"g"\nsensitivity_mv = 100.0\nfull_scale_v = 10')
    record = load(make_test(tmp_path, text))
    assert record.channels[0].full_scale == pytest.approx(100 * 9.80665)


def test_millivolts_of_an_uncalibrated_hammer_become_volts(tmp_path: Path) -> None:
    text = DESCRIPTION.replace('unit = "N"', 'unit = "V"\nuncalibrated = true')
    folder = make_test(tmp_path, text)
    write_csv(folder / "hit1.csv", {"hammer [mV]": DATA["hammer"] * 1e3, "tip": DATA["tip"]})
    assert_allclose(load(folder).force, DATA["hammer"], rtol=EXACT)


def test_an_uncalibrated_hammer_stays_in_volts_and_says_so(tmp_path: Path) -> None:
    text = DESCRIPTION.replace('unit = "N"', 'unit = "V"\nuncalibrated = true\nfull_scale_v = 10')
    record = load(make_test(tmp_path, text))
    assert not record.force_calibrated
    assert record.force_full_scale == 10.0
    assert_allclose(record.force, DATA["hammer"], rtol=EXACT)


@pytest.mark.parametrize(
    ("stated", "remedy"),
    [
        ('unit = "N"\nsensitivity_mv = 10', "add full_scale_v, the volts at full scale$"),
        ('unit = "V"\nuncalibrated = true', "add full_scale_v, the volts at full scale$"),
        (
            'unit = "N"',
            r"add full_scale_v \(volts at full scale\) and sensitivity_mv, or full_scale \(in N\)$",
        ),
    ],
)
def test_what_a_wav_lacks_depends_on_what_its_channel_states(
    tmp_path: Path, stated: str, remedy: str
) -> None:
    text = DESCRIPTION.replace('"hammer"', '"ch1"').replace('name = "tip"', 'name = "ch2"')
    text = text.replace('unit = "N"', stated).replace('"m/s^2"', '"m/s^2"\nfull_scale = 200')
    folder = make_test(tmp_path, text, file="hit.wav")
    wavfile.write(folder / "hit.wav", int(RATE), np.zeros((100, 2), np.int32))
    with pytest.raises(EmaError, match=remedy):
        load(folder)


def test_a_whole_number_wav_is_scaled_by_the_volts_at_full_scale(tmp_path: Path) -> None:
    text = DESCRIPTION.replace('"hammer"', '"ch1"').replace('name = "tip"', 'name = "ch2"')
    text = text.replace('unit = "N"', 'unit = "N"\nsensitivity_mv = 10\nfull_scale_v = 5')
    text = text.replace('unit = "m/s^2"', 'unit = "m/s^2"\nfull_scale = 200')
    folder = make_test(tmp_path, text, file="hit.wav")
    fractions = np.column_stack([DATA["hammer"] * 0.01 / 5, DATA["tip"] / 200])
    wavfile.write(folder / "hit.wav", int(RATE), np.round(fractions * 2**31).astype(np.int32))
    record = load(folder)
    assert_allclose(record.force, DATA["hammer"], atol=1e-6)
    assert_allclose(record.responses[0], DATA["tip"], atol=1e-6)
    (folder / "test.toml").write_text(
        (folder / "test.toml").read_text().replace("full_scale_v = 5", ""), encoding="utf-8"
    )
    assert "hit.wav: channel 'ch1': this WAV holds fractions of full scale; add full_scale_v" in message_of(
        folder
    )


CONTRADICTIONS = {
    "engineering unit and sensitivity": (
        {"hammer": "hammer", "tip": "tip [m/s^2]"},
        DESCRIPTION.replace('"m/s^2"', '"m/s^2"\nsensitivity_mv = 10'),
        "channel 'tip': the file is in 'm/s^2' already, but test.toml gives sensitivity_mv = 10",
    ),
    "volts without sensitivity": (
        {"hammer": "hammer (V)", "tip": "tip"},
        DESCRIPTION,
        "channel 'hammer': the file is in 'V', but test.toml has no sensitivity_mv",
    ),
    "millivolts without sensitivity": (
        {"hammer": "hammer", "tip": "tip (mV)"},
        DESCRIPTION,
        "channel 'tip': the file is in 'mV', but test.toml has no sensitivity_mv",
    ),
    "another quantity": (
        {"hammer": "hammer", "tip": "tip [mm/s]"},
        DESCRIPTION,
        "channel 'tip': the file is in 'mm/s' but test.toml says 'm/s^2'",
    ),
    "another unit of the same quantity": (
        {"hammer": "hammer", "tip": "tip [g]"},
        DESCRIPTION,
        "channel 'tip': the file is in 'g' but test.toml says 'm/s^2'",
    ),
    "force in newtons marked uncalibrated": (
        {"hammer": "hammer [N]", "tip": "tip"},
        DESCRIPTION.replace('"N"', '"V"\nuncalibrated = true'),
        "channel 'hammer': is marked uncalibrated, but the file is in 'N'",
    ),
    "sample rate": (
        {"hammer": "hammer", "tip": "tip"},
        DESCRIPTION.replace("2048", "2050"),
        "sample rate is 2048 Hz in the file but 2050 Hz in",
    ),
    "channel in other case": (
        {"hammer": "Hammer", "tip": "tip"},
        DESCRIPTION,
        "has no channel 'hammer' (did you mean 'Hammer'? the file holds: Hammer, tip)",
    ),
    "channel misspelt": (
        {"hammer": "hamer", "tip": "tip"},
        DESCRIPTION,
        "has no channel 'hammer' (did you mean 'hamer'?; the file holds: hamer, tip)",
    ),
    "channel missing": (
        {"hammer": "hammer", "tip": "qqq"},
        DESCRIPTION,
        "has no channel 'tip' (the file holds: hammer, qqq)",
    ),
}


@pytest.mark.parametrize("case", list(CONTRADICTIONS))
def test_a_file_that_contradicts_its_description_is_refused(tmp_path: Path, case: str) -> None:
    names, text, expected = CONTRADICTIONS[case]
    folder = make_test(tmp_path, text)
    write_csv(folder / "hit1.csv", {names[n]: x for n, x in DATA.items()})
    message = message_of(folder)
    assert "hit1.csv" in message
    assert expected in message


def test_a_uff_label_counts_as_the_files_own_unit(tmp_path: Path) -> None:
    folder = make_test(tmp_path, file="hit.uff")
    write_uff(folder / "hit.uff", DATA, binary=True, ordinate_axis_units_lab="V")
    assert "hit.uff: channel 'hammer': the file is in 'V'" in message_of(folder)


def test_times_of_no_stated_unit_that_may_be_milliseconds_are_refused(tmp_path: Path) -> None:
    folder = make_test(tmp_path, DESCRIPTION.replace("sample_rate_hz = 2048", ""))
    seconds = (folder / "hit1.csv").read_text("utf-8").splitlines()[1:]
    rows = [f"{1e3 * float(r.partition(',')[0]):.9g},{r.partition(',')[2]}" for r in seconds]
    names = ",".join(["{time}", *DATA])
    for time, said in (
        ("time", "read as seconds, tell 2.048 Hz; write their unit in their name"),
        ("time_ms", ""),
    ):
        (folder / "hit1.csv").write_text("\n".join([names.format(time=time), *rows]) + "\n", "utf-8")
        if said:
            assert said in message_of(folder)
        else:
            assert load(folder).sample_rate_hz == pytest.approx(2048.0)


def test_a_slow_rate_that_the_header_states_needs_no_unit_of_time(tmp_path: Path) -> None:
    folder = make_test(tmp_path, DESCRIPTION.replace("sample_rate_hz = 2048", ""))
    table = np.column_stack([np.arange(len(DATA["hammer"])) / 50, *DATA.values()])
    rows = [",".join(["time", *DATA]), *(",".join(f"{v:.9g}" for v in row) for row in table)]
    (folder / "hit1.csv").write_text("\n".join(["Sample rate: 50 Hz", *rows]) + "\n", "utf-8")
    assert load(folder).sample_rate_hz == 50.0
    (folder / "hit1.csv").write_text("\n".join(rows) + "\n", "utf-8")
    assert "read as seconds, tell 50 Hz" in message_of(folder)


def test_without_any_sample_rate_the_record_is_refused(tmp_path: Path) -> None:
    folder = make_test(tmp_path, DESCRIPTION.replace("sample_rate_hz = 2048", ""))
    write_csv(folder / "hit1.csv", DATA, with_time=False)
    assert "hit1.csv: states no sample rate; add sample_rate_hz" in message_of(folder)


def test_records_of_one_test_must_share_their_sample_rate(tmp_path: Path) -> None:
    text = DESCRIPTION.replace("sample_rate_hz = 2048", "")
    folder = make_test(tmp_path, text + '[[records]]\nfile = "hit2.csv"\nimpact = "tip.z"\n')
    slow = (folder / "hit1.csv").read_text().splitlines()
    halved = [slow[0]] + [f"{2 * float(t)},{rest}" for t, rest in (r.split(",", 1) for r in slow[1:])]
    (folder / "hit2.csv").write_text("\n".join(halved))
    assert "hit2.csv: sample rate 1024 Hz differs from 2048 Hz of 'hit1.csv'" in message_of(folder)


def test_a_sample_rate_need_not_be_a_whole_number(tmp_path: Path) -> None:
    folder = make_test(tmp_path, DESCRIPTION.replace("2048", "1706.6667"))
    write_csv(folder / "hit1.csv", DATA, with_time=False)
    assert load(folder).sample_rate_hz == 1706.6667


def test_times_rounded_to_a_tenth_of_a_millisecond_do_not_contradict_the_stated_rate(tmp_path: Path) -> None:
    folder = make_test(tmp_path)
    short = {n: x[:200] for n, x in DATA.items()}
    rows = [f"{i / RATE:.4f},{a:.9g},{b:.9g}" for i, (a, b) in enumerate(zip(*short.values(), strict=True))]
    (folder / "hit1.csv").write_text("time,hammer,tip\n" + "\n".join(rows))
    assert load(folder).sample_rate_hz == RATE


@pytest.mark.parametrize(
    ("speed", "said"),
    [(1.0, ""), (0.5, "sample rate is 4096 Hz in the file but 2048 Hz in ")],
)
def test_stamps_in_milliseconds_are_held_against_the_stated_rate(
    tmp_path: Path, speed: float, said: str
) -> None:
    folder = make_test(tmp_path)
    rows = [
        f"{speed * i / RATE:.3f},{a:.9g},{b:.9g}" for i, (a, b) in enumerate(zip(*DATA.values(), strict=True))
    ]
    (folder / "hit1.csv").write_text("time,hammer,tip\n" + "\n".join(rows))
    if said:
        assert said in message_of(folder)
    else:
        assert load(folder).sample_rate_hz == RATE


def test_stamps_too_coarse_for_a_rate_ask_for_one(tmp_path: Path) -> None:
    folder = make_test(tmp_path, DESCRIPTION.replace("sample_rate_hz = 2048", ""))
    rows = [f"{i / RATE:.1f},{a:.9g},{b:.9g}" for i, (a, b) in enumerate(zip(*DATA.values(), strict=True))]
    (folder / "hit1.csv").write_text("time,hammer,tip\n" + "\n".join(rows))
    assert "time stamps are too coarse to tell the sample rate" in message_of(folder)
    assert "add sample_rate_hz" in message_of(folder)


def test_channels_of_different_length_are_refused(tmp_path: Path) -> None:
    import h5py

    folder = make_test(tmp_path, file="hit.h5")
    with h5py.File(folder / "hit.h5", "w") as file:
        file["hammer"], file["tip"] = DATA["hammer"], DATA["tip"][:-5]
    assert "hit.h5: channels differ in length ('tip' 2043 samples, 'hammer' 2048)" in message_of(folder)


def test_a_file_of_many_channels_is_opened_once_to_check_and_once_to_store_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import h5py

    from ema_pipeline import codec

    folder = make_test(tmp_path, file="hit.h5")
    long = {name: np.concatenate([samples, np.zeros(LONG)]) for name, samples in DATA.items()}
    more = [f"more{k}" for k in range(6)]
    with h5py.File(folder / "hit.h5", "w") as file:
        for name in ("hammer", "tip", *more):
            file[name] = long["hammer" if name == "hammer" else "tip"]
    channels = "".join(
        f'[[channels]]\nname = "{name}"\nquantity = "acceleration"\nunit = "m/s^2"\ndof = "{name}.x"\n'
        for name in more
    )
    text = (folder / "test.toml").read_text(encoding="utf-8")
    (folder / "test.toml").write_text(text + channels, encoding="utf-8")
    opened, really = [], h5py.File

    def counting(path: Path, *args: object, **kwargs: object) -> h5py.File:
        opened.append(Path(path).name)
        return really(path, *args, **kwargs)

    monkeypatch.setattr(h5py, "File", counting)
    record = load(folder)
    assert opened == ["hit.h5"] * 2  # to check all channels, and for the force
    with really(tmp_path / "store.h5", "w") as store:
        codec.write(store, "responses", record.responses)
        assert opened == ["hit.h5"] * 3
        assert_allclose(store["responses"][()], np.tile(long["tip"], (7, 1)), rtol=0)
    assert record.responses[3, 5:9].shape == (4,)  # opened for itself
    assert opened == ["hit.h5"] * 4
    (folder / "hit.h5").unlink()
    with pytest.raises(EmaError, match=r"hit\.h5: .*cannot be read"), really(tmp_path / "b.h5", "w") as store:
        codec.write(store, "responses", record.responses)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_no_numbers_are_refused_with_their_time(tmp_path: Path, value: float) -> None:
    import h5py

    folder = make_test(tmp_path, file="hit.h5")
    with h5py.File(folder / "hit.h5", "w") as file:
        spoilt = DATA["tip"].copy()
        spoilt[1024] = value
        file["hammer"], file["tip"] = DATA["hammer"], spoilt
    assert f"hit.h5: channel 'tip': {value} at sample 1024 (0.5 s), 1 such in all" in message_of(folder)


@pytest.mark.parametrize(
    ("name", "factor", "refused"),
    [("tip", 1e-100, True), ("hammer", 1e-320, True), ("tip", 1e-12, False), ("tip", 0.0, False)],
)
def test_values_below_all_measurement_are_refused_but_not_a_silent_channel(
    tmp_path: Path, name: str, factor: float, refused: bool
) -> None:
    folder = make_test(tmp_path)
    write_csv(folder / "hit1.csv", {**DATA, name: factor * DATA[name]})
    if refused:
        message = message_of(folder)
        assert f"hit1.csv: channel '{name}': " in message
        assert "below all measurement once scaled" in message
    else:
        load(folder)


def test_a_record_of_fewer_than_64_samples_is_refused(tmp_path: Path) -> None:
    folder = make_test(tmp_path)
    write_csv(folder / "hit1.csv", {n: x[:63] for n, x in DATA.items()})
    assert "hit1.csv: channel 'hammer' has 63 samples, at least 64 are needed" in message_of(folder)


def test_a_dead_hammer_is_left_to_the_quality_checks(tmp_path: Path) -> None:
    folder = make_test(tmp_path)
    write_csv(folder / "hit1.csv", {"hammer": np.zeros(2048), "tip": DATA["tip"]})
    assert not load(folder).force.any()


def test_swapped_hammer_and_accelerometer_are_noticed(tmp_path: Path) -> None:
    folder = make_test(tmp_path)
    write_csv(folder / "hit1.csv", {"hammer": DATA["tip"], "tip": DATA["hammer"]})
    message = message_of(folder)
    assert "hit1.csv: channels 'hammer' and 'tip' look swapped" in message
    assert "test.toml" in message


def test_a_doubly_struck_noisy_or_dead_hammer_is_not_called_swapped() -> None:
    force, response = DATA["hammer"], DATA["tip"]
    rng = np.random.default_rng(3)
    hum = np.sin(2 * np.pi * 50 * np.arange(2048) / RATE)
    spike = np.zeros(2048)
    spike[100:103] = 50.0  # a loose cable looks like a pulse
    for suspect in (
        force + np.roll(force, 40),
        force + 0.5 * np.roll(force, 9),
        force + 10 * rng.standard_normal(2048),
        rng.standard_normal(2048),
        np.zeros(2048),
        hum,
        force + 5 * hum,
    ):
        assert find_swap(suspect, {"tip": response, "loose": spike}) is None
        assert find_swap(suspect, {"tip": response}) is None


def test_real_and_simulated_records_load_and_none_is_called_swapped(test_data: Path) -> None:
    count = 0
    for root in [*sorted((test_data / "blind").iterdir()), *sorted((test_data / "realdata").iterdir())]:
        described = list(root.rglob("test.toml")) if root.is_dir() else []
        kinds = {tomllib.loads(p.read_text(encoding="utf-8")).get("kind") for p in described}
        if not described or "continuous" in kinds:  # a kind that is refused, see test_ingest_description
            continue
        for test in read_campaign(root).tests:
            if test.kind == "hammer":
                for record in load_records(test):
                    count += 1
                    assert np.max(np.abs(record.force)) > 1.0
            else:
                for entry in test.records:
                    assert set(load_channels(test, entry).samples) == {"force", "displacement"}
    assert count >= 190


def test_exchanging_hammer_and_driving_point_of_real_records_is_noticed(test_data: Path) -> None:
    test = read_description(test_data / "realdata" / "five_hits_25600hz")
    for record in load_records(test):
        found = find_swap(record.responses[0], {"hammer": record.force})
        assert found is not None


def test_known_scaling_of_the_blind_records(test_data: Path) -> None:
    test = read_campaign(test_data / "blind" / "p2").tests[0]
    record = load_record(test, next(r for r in test.records if r.file == "sun_y_150N_1.uff"))
    assert np.max(np.abs(record.force)) == pytest.approx(150.0, rel=0.2)
    assert record.sample_rate_hz == 5120.0


def test_importing_ingest_loads_no_heavy_reader() -> None:
    code = (
        "import sys, ema_pipeline.ingest\n"
        "print(sorted({'pandas', 'pyuff', 'nptdms', 'lvm_read', 'h5py', 'matplotlib'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_two_names_of_one_channel_are_no_two_sensors(tmp_path: Path) -> None:
    second = (
        '[[channels]]\nname = "tip [m/s^2]"\nquantity = "acceleration"\nunit = "m/s^2"\ndof = "root.z"\n\n'
    )
    folder = make_test(tmp_path, DESCRIPTION.replace("[[records]]", second + "[[records]]"))
    assert "hit1.csv: 'tip' and 'tip [m/s^2]' are one channel of the file; correct the name" in message_of(
        folder
    )
