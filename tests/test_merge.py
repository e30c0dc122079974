"""Several set-ups of one state as one test: two hammers, roving sensors, and what cannot be merged."""

from __future__ import annotations

import dataclasses
import json
import shutil
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from bench import ema
from numpy.typing import NDArray
from typer.testing import CliRunner

from ema_pipeline.cli import app
from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.channels import ChannelQuality
from ema_pipeline.frf.parts import gain_ratios, joined
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.campaign import read_campaign
from ema_pipeline.merge import Part, merge
from ema_pipeline.run.measured import measured_frfs, measured_modes
from ema_pipeline.run.opening import existing_run
from ema_pipeline.simulate import simulate_campaign

BODIES = 6
STIFFNESS = [5e6 * (1 + 0.1 * k) for k in range(1, BODIES + 1)]
MASS = [0.5 + 0.05 * k for k in range(1, BODIES + 1)]
SOFT = {"contact_s": 4e-3, "peak_force_n": 300.0, "seed": 1}
HARD = {"contact_s": 4e-4, "peak_force_n": 60.0, "seed": 2}
MEASURE = 'stages=["ingest","hits","frf","modal"]'


def _truth() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frequencies in Hz and shapes (bodies, modes) of the chain, from its own matrices."""
    k = np.diag([a + b for a, b in zip(STIFFNESS, [*STIFFNESS[1:], 0.0], strict=True)])
    k -= np.diag(STIFFNESS[1:], 1) + np.diag(STIFFNESS[1:], -1)
    squares, shapes = scipy.linalg.eigh(k, np.diag(MASS))
    return np.sqrt(squares) / (2 * np.pi), shapes


def _rig(path: Path) -> Path:
    lines = ['name = "chain"', "modal_damping_ratio = 0.01", "[parameters]"]
    names = range(1, BODIES + 1)
    lines += [
        f'k{i} = {{ value = {k}, unit = "N/m", tolerance = 0.05 }}'
        for i, k in zip(names, STIFFNESS, strict=True)
    ]
    lines += [f'[[masses]]\nat = "m{i}.x"\nvalue = {m}' for i, m in zip(names, MASS, strict=True)]
    lines += ['[[springs]]\nname = "k1"\nvalue = "k1"\nat = "m1.x"']
    lines += [
        f'[[springs]]\nname = "k{i}"\nvalue = "k{i}"\nbetween = ["m{i - 1}.x", "m{i}.x"]'
        for i in names
        if i > 1
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _simulate(folder: Path, **settings: object) -> Path:
    folder.parent.mkdir(parents=True, exist_ok=True)
    given = {
        "hits": 3, "sample_rate_hz": 5120.0, "duration_s": 1.0, "acceleration_noise": 0.5, "format": "hdf5",
        "impacts": ["m1.x", "m6.x"],
    }  # fmt: skip
    simulate_campaign(folder, str(_rig(folder.parent / "chain.toml")), **given | settings)
    return folder


def _modes(capsys: pytest.CaptureFixture[str], raw: Path, out: Path) -> MeasuredModes:
    code, _, err = ema(capsys, "run", raw, "--out", out, "--set", MEASURE, "--quiet")
    assert code == 0, err
    return measured_modes(existing_run(out))["default"]


def _nearest(modes: MeasuredModes, frequency_hz: float) -> int:
    return int(np.argmin(np.abs(modes.frequency_hz - frequency_hz)))


@pytest.fixture(scope="module")
def tips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A soft tip that strikes hard and carries nothing above 700 Hz, a hard tip that is weak."""
    root = tmp_path_factory.mktemp("tips")
    _simulate(root / "soft", **SOFT)
    _simulate(root / "hard", **HARD)
    # another hammer, whose certificate is 3 % off
    text = (root / "hard" / "test.toml").read_text(encoding="utf-8")
    assert "sensitivity_mv = 2.25" in text
    (root / "hard" / "test.toml").write_text(
        text.replace("sensitivity_mv = 2.25", "sensitivity_mv = 2.3175"), encoding="utf-8"
    )
    return root


@pytest.fixture(scope="module")
def run_of(tips: Path) -> dict[str, Path]:
    """Results folders of the two tips, run up to their modes: `merge` takes them in place of raw folders."""
    for name in ("soft", "hard"):
        words = ["run", str(tips / name), "--out", str(tips / f"out_{name}"), "--set", MEASURE, "--quiet"]
        done = CliRunner().invoke(app, words)
        assert done.exit_code == 0, done.output
    return {name: tips / f"out_{name}" for name in ("soft", "hard")}


@pytest.fixture(scope="module")
def merged(tips: Path) -> dict[str, Any]:
    """What merging the two tips into ``tips/both`` says."""
    command = ["merge", str(tips / "soft"), str(tips / "hard"), "--out", str(tips / "both"), "--json"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)  # type: ignore[no-any-return]


@pytest.mark.slow
@pytest.mark.usefixtures("merged")
def test_two_tips_are_as_good_as_each_on_its_own_band(
    tips: Path, run_of: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Frequencies by the chain's own matrices; as precise as the better tip, mode by mode."""
    both = _modes(capsys, tips / "both", tmp_path / "out")
    alone = [measured_modes(existing_run(run_of[name]))["default"] for name in ("soft", "hard")]
    assert len(alone[0]) < BODIES <= len(both)
    for frequency in _truth()[0]:
        k = _nearest(both, frequency)
        error, std = both.frequency_hz[k] - frequency, both.frequency_std_hz[k]
        assert abs(error) < 4 * std + 2e-6 * frequency, frequency
        stds = [m.frequency_std_hz[_nearest(m, frequency)] for m in alone if _has(m, frequency)]
        assert std < 1.3 * min(stds), frequency
    # the low modes are the soft tip's, the high ones exist only by the hard tip
    low = _truth()[0][0]
    assert both.frequency_std_hz[0] < 0.2 * alone[1].frequency_std_hz[_nearest(alone[1], low)]


def _has(modes: MeasuredModes, frequency_hz: float) -> bool:
    return bool(np.min(np.abs(modes.frequency_hz / frequency_hz - 1)) < 1e-3)


def test_what_merge_says(tips: Path, merged: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    found = merged
    soft, hard = found["parts"]
    assert (
        375 < soft["band_hz"][1] < 800 < 1900 < hard["band_hz"][1] <= 2000
    )  # half-sine of 4 ms: zero at 375 Hz
    assert found["band_hz"][1] == hard["band_hz"][1]
    (gain,) = found["gains"]
    # FRFs of the hard tip are 3 % too small: its sensitivity is stated 3 % too high, so its force is read too low
    assert gain["ln_ratio"] == pytest.approx(-np.log(1.03), abs=4 * gain["std"] + 1e-3)
    text = (tips / "both" / "soft" / "test.toml").read_text(encoding="utf-8")
    assert text.startswith('part = "soft"\nband_hz = [')
    code, out, _ = ema(capsys, "check", tips / "both", "--json")
    files = {h["file"] for hits in json.loads(out).values() for h in hits}
    assert code == 0
    assert len(files) == 12
    assert "hard/m1_x_60N_1.h5" in files


@pytest.mark.slow
def test_roving_sensors_make_whole_shapes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Three sensors at a time, one hammer: shapes over all bodies as the chain's matrices have them."""
    for name, sensors, seed in (
        ("first", ("m1.x", "m2.x", "m3.x"), 1),
        ("second", ("m4.x", "m5.x", "m6.x"), 2),
    ):
        _simulate(tmp_path / name, **HARD | {"seed": seed, "sensors": list(sensors)})
    code, _out, err = ema(
        capsys, "merge", tmp_path / "first", tmp_path / "second", "--out", tmp_path / "all", "--quiet"
    )
    assert (code, err) == (0, "")
    modes = _modes(capsys, tmp_path / "all", tmp_path / "out")
    frequencies, shapes = _truth()
    order = [[d.point for d in modes.dofs].index(f"m{i}.x") for i in range(1, BODIES + 1)]
    for k, frequency in enumerate(frequencies):
        found = modes.shapes[_nearest(modes, frequency)][order]
        mac = abs(np.vdot(found, shapes[:, k])) ** 2 / (
            np.vdot(found, found).real * np.vdot(shapes[:, k], shapes[:, k])
        )
        assert mac > 0.999, frequency


def test_tests_of_two_states_are_refused(
    run_of: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mass of 30 g between the two set-ups."""
    _simulate(tmp_path / "later", effects=["mass@m3.x"], values={"mass@m3.x.mass": 0.03}, **HARD)
    _modes(capsys, tmp_path / "later", tmp_path / "out_later")
    sources = (run_of["soft"], tmp_path / "out_later")
    _refused(capsys, tmp_path / "both", "are not of one state", "mode at", *sources)
    out = ("--out", tmp_path / "both")
    code, _, err = ema(capsys, "merge", *sources, *out, "--tolerance", "0.05", "--quiet")
    assert (code, err) == (0, "")


def _rewritten(raw: Path, folder: Path, *changes: tuple[str, str]) -> Path:
    """A copy of a raw folder with these texts of its description replaced."""
    shutil.copytree(raw, folder)
    file = folder / "test.toml"
    text = file.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    file.write_text(text, encoding="utf-8")
    return folder


def test_what_descriptions_tell_is_refused_before_modes_are_identified(
    tips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_raw(*_: object) -> None:
        raise AssertionError("was run")

    monkeypatch.setattr("ema_pipeline.merge.run_raw", run_raw)
    out, hard = tmp_path / "both", tips / "hard"

    def other(name: str, *changes: tuple[str, str]) -> Path:
        return _rewritten(hard, tmp_path / name, *changes)

    slow = _simulate(tmp_path / "slow", **SOFT | {"sample_rate_hz": 2560.0})
    _refused(capsys, out, "sample rate", "record all parts at one rate", hard, slow)
    apart = _simulate(tmp_path / "apart", **HARD | {"impacts": ["m2.x"], "sensors": ["m3.x"]})
    alone = _simulate(tmp_path / "alone", **HARD | {"impacts": ["m1.x"], "sensors": ["m1.x"]})
    _refused(capsys, out, "strikes no point", "leave one sensor", alone, apart)
    _refused(capsys, out, "nothing to merge", "two or more", hard)
    _refused(capsys, out, "called 'hard', too", "rename one", hard, other("again/hard"))
    renamed = other("else", ("configuration =", 'configuration = "else"  #'))
    _refused(capsys, out, "only tests of one configuration", "'else'", hard, renamed)
    window = other("window", ("sample_rate_hz =", "exponential_window_rad_s = 5.0\nsample_rate_hz ="))
    _refused(capsys, out, "different exponential windows", "record them alike", hard, window)
    volts = other("volts", ('unit = "N"\nsensitivity_mv = 2.3175', 'unit = "V"\nuncalibrated = true'))
    _refused(capsys, out, "calibrated in only one", "state its sensitivity", hard, volts)
    velocity = other("velocity", ('"acceleration"', '"velocity"'), ('"m/s^2"', '"m/s"'))
    _refused(capsys, out, "is measured as acceleration in part 'hard'", "one kind", hard, velocity)
    rig = other("rig")
    rig.joinpath("rig.toml").write_text('name = "another"', encoding="utf-8")
    _refused(capsys, out, "rig.toml differ", "copy the right one", hard, rig)
    within = other("above/test")
    within.joinpath("rig.toml").unlink()
    within.parent.joinpath("rig.toml").write_text('name = "another"', encoding="utf-8")
    _refused(capsys, out, "above/rig.toml differ", "copy the right one", hard, within.parent)
    named = [
        other(name, ("sample_rate_hz =", f'rig = "{name}"\nsample_rate_hz ='))
        for name in ("gearbox", "isolator")
    ]
    _refused(capsys, out, "names rig 'isolator'", "one test has one rig", *named)
    _refused(capsys, out, "hard: is given twice", "", hard, hard.parent / "soft" / ".." / "hard")
    out.mkdir()
    code, _, err = ema(capsys, "merge", hard, tips / "soft", "--out", out)
    assert code == 1
    assert "exists already" in err


def test_a_common_point_whose_hits_were_all_left_out_connects_nothing(
    tips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def identified(part: Any, *_: object) -> Part:
        own = (Dof.parse(f"{part.name}.x"),)
        frfs = dataclasses.replace(_frfs(0.01, (1, 500), 1), outputs=own, inputs=own)
        return Part(part.name, part.raw, part.test, None, frfs, None)  # type: ignore[arg-type]

    monkeypatch.setattr("ema_pipeline.merge._identified", identified)
    with pytest.raises(EmaError, match="hard: strikes no point"):
        merge([tips / "soft", tips / "hard"], tmp_path / "both")


def test_hammers_that_contradict_each_other_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = _simulate(tmp_path / "one", **HARD | {"impacts": ["m1.x"], "sensors": ["m1.x"]})
    other = _rewritten(one, tmp_path / "other", ("= 2.25", "= 22.5"))
    _refused(capsys, tmp_path / "both", "differ by a factor of 10", "sensitivity_mv", one, other)


def _refused(capsys: pytest.CaptureFixture[str], out: Path, what: str, remedy: str, *sources: Path) -> None:
    code, _, err = ema(capsys, "merge", *sources, "--out", out, "--quiet")
    assert (code, err.count("\n")) == (1, 1), err
    assert what in err, err
    assert remedy in err, err
    assert not out.exists()


def test_two_tests_of_one_configuration_name_the_remedy(tips: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        shutil.copytree(tips / "hard", tmp_path / "raw" / name)
    from ema_pipeline.ingest import read_campaign

    with pytest.raises(EmaError, match=r"both describe configuration 'default'.*ema merge"):
        read_campaign(tmp_path / "raw")


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        (('part = "../up"', 'part = "b"'), "part '../up'"),
        (('part = "a"', 'part = "a"'), "both part 'a'"),
        (('part = "a"', ""), "both describe configuration"),
        (('part = "a"\nband_hz = [5.0, 2.0]', 'part = "b"'), "is no band"),
        (('part = "a"\nband_hz = [5.0]', 'part = "b"'), "band_hz"),
    ],
)
def test_parts_written_by_hand_are_checked(
    tips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], keys: tuple[str, str], said: str
) -> None:
    for name, key in zip(("one", "two"), keys, strict=True):
        shutil.copytree(tips / "hard", tmp_path / "raw" / name)
        file = tmp_path / "raw" / name / "test.toml"
        file.write_text(f"{key}\n{file.read_text(encoding='utf-8')}", encoding="utf-8")
    code, _, err = ema(capsys, "run", tmp_path / "raw", "--out", tmp_path / "out")
    assert (code, err.count("\n")) == (1, 1), err
    assert said in err, err


def _frfs(std: float, band_hz: tuple[float, float], seed: int, gain: float = 1.0, lines: int = 801) -> FrfSet:
    """One driving point, H = (1 + 1j)·gain with noise of a known deviation."""
    noise = np.random.default_rng(seed).standard_normal((2, 1, 1, lines)) * std / np.sqrt(2)
    shape = (1, 1, lines)
    return FrfSet(
        frequency_hz=np.arange(lines, dtype=float),
        frf=gain * (np.full(shape, 1 + 1j) + noise[0] + 1j * noise[1]),
        coherence=np.full(shape, 0.99),
        variance=np.full(shape, (gain * std) ** 2),
        outputs=(Dof.parse("a.x"),),
        inputs=(Dof.parse("a.x"),),
        quantities=("acceleration",),
        hits=np.full((1, 1), 3),
        estimator="H1",
        record_s=1.0,
        response_decay_rad_s=0.0,
        delay_s=np.zeros(1),
        band_hz=band_hz,
        force_calibrated=True,
        sensor_mass_kg=np.zeros(1),
        channels=(ChannelQuality("a"),),
        hammer=ChannelQuality("hammer"),
    )


def test_overlap_is_weighted_by_the_inverse_variance() -> None:
    """Each alone in its own band, and in the overlap the least variance that two parts can give."""
    soft, hard = _frfs(0.01, (1, 500), 1), _frfs(0.03, (200, 800), 2)
    both = joined({"soft": soft, "hard": hard})
    assert both.band_hz == (1, 800)
    gain = both.frf[0, 0, 100] / soft.frf[0, 0, 100]  # the noise of the ratio of two equal gains
    assert abs(gain - 1) < 0.005
    np.testing.assert_allclose(both.frf[0, 0, 1:200], gain * soft.frf[0, 0, 1:200], rtol=1e-9)
    overlap = both.variance[0, 0, 201:500]
    np.testing.assert_allclose(overlap, 1 / (1 / 0.01**2 + 1 / 0.03**2), rtol=0.02)
    np.testing.assert_allclose(both.variance[0, 0, 501:], 0.03**2, rtol=0.02)
    error = np.mean(np.abs(both.frf[0, 0, 201:500] - (1 + 1j)) ** 2)
    assert error == pytest.approx(
        float(np.mean(overlap)), rel=0.35
    )  # 299 lines: 6 %, and the common gain's error
    assert both.hits[0, 0] == 6


def test_gains_of_two_hammers_meet_in_the_middle() -> None:
    soft, hard = _frfs(0.01, (1, 500), 1), _frfs(0.01, (200, 800), 2, gain=1.04)
    ((value, std),) = gain_ratios({"soft": soft, "hard": hard}).values()
    assert value == pytest.approx(-np.log(1.04), abs=4 * std)
    both = joined({"soft": soft, "hard": hard})
    level = np.abs(both.frf[0, 0]) / np.sqrt(2)
    # equal calibrations: the geometric mean, without a step from one band to the other
    assert np.mean(level[1:200]) == pytest.approx(np.sqrt(1.04), abs=3e-3)
    assert np.mean(level[501:]) == pytest.approx(np.sqrt(1.04), abs=3e-3)
    exact = dataclasses.replace(soft, hammer=ChannelQuality("hammer", 0.0))
    level = np.abs(joined({"soft": exact, "hard": hard}).frf[0, 0]) / np.sqrt(2)
    assert np.mean(level[501:]) == pytest.approx(1.0, abs=3e-3)  # the one that is known better rules


@pytest.mark.parametrize(
    ("gain", "said"),
    [(10.0, "differ by a factor of 10, .*sensitivity_mv"), (-1.0, "opposite signs: .*reversed")],
)
def test_gains_that_no_calibration_explains_are_refused(gain: float, said: str) -> None:
    with pytest.raises(EmaError, match=said):
        joined({"soft": _frfs(0.01, (1, 500), 1), "hard": _frfs(0.01, (200, 800), 2, gain=gain)})


def test_a_gap_between_bands_is_refused() -> None:
    with pytest.raises(EmaError, match="no part covers 300 to 400 Hz"):
        joined({"soft": _frfs(0.01, (1, 300), 1), "hard": _frfs(0.01, (400, 800), 2)})


def test_a_band_that_is_stated_holds(tips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(tips / "hard", tmp_path / "raw")
    file = tmp_path / "raw" / "test.toml"
    text = file.read_text(encoding="utf-8")
    file.write_text("band_hz = [300.0, 1200.0]\n" + text, encoding="utf-8")
    code, _, err = ema(
        capsys, "run", tmp_path / "raw", "--out", tmp_path / "out", "--set", MEASURE, "--quiet"
    )
    assert code == 0, err
    run = existing_run(tmp_path / "out")
    assert measured_frfs(run)["default"].band_hz == (300.0, 1200.0)
    frequencies = measured_modes(run)["default"].frequency_hz
    assert len(frequencies) == 5
    assert frequencies.min() > 300
    for stated, said in (("[900, 300]", "is no band"), ("[2200.0, 2500.0]", "has enough energy")):
        file.write_text(f"band_hz = {stated}\n" + text, encoding="utf-8")
        code, _, err = ema(
            capsys, "run", tmp_path / "raw", "--out", tmp_path / "bad", "--set", MEASURE, "--quiet"
        )
        assert (code, err.count("\n")) == (1, 1), err
        assert said in err, err


def test_merge_takes_results_folders(tips: Path, run_of: dict[str, Path], tmp_path: Path) -> None:
    merged = merge([run_of["soft"], tips / "hard"], tmp_path / "both")
    assert [p.name for p in merged.parts] == ["soft", "hard"]
    assert (tmp_path / "both" / "hard" / "test.toml").is_file()
    assert (tmp_path / "both" / "rig.toml").is_file()


def test_descriptions_in_brackets_and_over_several_lines_are_merged(tips: Path, tmp_path: Path) -> None:
    """Keys and tables may stand as TOML allows; what is written can be read again."""
    for name in ("soft", "hard"):
        shutil.copytree(tips / name, tmp_path / name)
        file = tmp_path / name / "test.toml"
        keys = tomllib.loads(file.read_text(encoding="utf-8"))
        band = "[20.0,\n  700.0\n]" if name == "soft" else "[20.0,\n  2000.0\n]"
        lines = [f"band_hz = {band}", f'title = """\n[{name}]"""', "sample_rate_hz = 5120"]
        lines += [
            f"{table} = [{', '.join(_inline(x) for x in keys[table])}]" for table in ("channels", "records")
        ]
        file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    merge([tmp_path / "soft", tmp_path / "hard"], tmp_path / "both")
    tests = {t.part: t for t in read_campaign(tmp_path / "both").tests}
    assert set(tests) == {"soft", "hard"}
    assert tests["soft"].title == "[soft]"
    assert tests["soft"].band_hz == (20.0, 700.0)


def _inline(table: dict[str, Any]) -> str:
    return "{" + ", ".join(f"{key} = {json.dumps(value)}" for key, value in table.items()) + "}"
