"""Hits judged as their files arrive: whole, half-written, bad, unreadable, judged again once they grow."""

from __future__ import annotations

import json
import shutil
import threading
import time
from pathlib import Path

import pytest
from bench import ema, write_bench

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.description import read_description
from ema_pipeline.watch.arrivals import Arrival
from ema_pipeline.watch.live import judged_files
from ema_pipeline.watch.session import Session, Told


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four files on each of two points, the last one bounces; CSV, so that half of a file can be read."""
    root = tmp_path_factory.mktemp("watch")
    return write_bench(root, hits=4, format="csv", double_hits=("m3.x#4",))


def _channels(source: Path, folder: Path) -> Path:
    """A folder whose test.toml knows the channels and no record."""
    folder.mkdir(parents=True)
    text = (source / "test.toml").read_text(encoding="utf-8").split("[[records]]")[0]
    (folder / "test.toml").write_text(text, encoding="utf-8")
    return folder


def _watched(
    folder: Path, write: object, count: int, points: tuple[str, ...] = (), poll: bool = False
) -> list[Told]:
    """What is told while `write` puts files into the folder, until `count` lines."""
    session, stop = Session(folder, points), threading.Event()
    writer = threading.Thread(target=write)  # type: ignore[arg-type]
    told: list[Told] = []
    deadline = time.monotonic() + 30
    started = False
    for one in judged_files(session, poll, stop):
        if not started:
            writer.start()
            started = True
        if one is not None:
            told.append(one)
        if len(told) >= count or time.monotonic() > deadline:
            break
    stop.set()
    writer.join()
    return told


@pytest.mark.parametrize("poll", [False, True])
def test_files_are_judged_within_a_second(source: Path, tmp_path: Path, poll: bool) -> None:
    """Written in two halves, with a pause; one broken for good; the folder can be run in the end."""
    folder = _channels(source, tmp_path / "live")
    files = sorted(source.glob("*.csv"))

    def write() -> None:
        for file in files:
            content = file.read_bytes()
            with (folder / file.name).open("wb") as half:
                half.write(content[: len(content) // 2])
                half.flush()
                time.sleep(0.1)
                half.write(content[len(content) // 2 :])
        (folder / "m1_x_broken.csv").write_bytes(b"\x00\x01rubbish" * 100)

    told = _watched(folder, write, len(files) + 1, poll=poll)
    assert sorted(t.file for t in told) == sorted([*(f.name for f in files), "m1_x_broken.csv"])
    assert max(t.seconds for t in told) < 1.5  # 1 s on a machine that does nothing else
    by_name = {t.file: t for t in told}
    (bounce,) = [f.name for f in files if "m3" in f.name and f.stem.endswith("_4")]
    assert not by_name["m1_x_broken.csv"].good
    for file in files:
        record = by_name[file.name].record
        assert record is not None
        assert bool(record.good) == (file.name != bounce), by_name[file.name].text
        assert str(record.impact) == ("m1.x" if "m1" in file.name else "m3.x")
    assert "second impact" in by_name[bounce].text
    last = [t for t in told if t.record is not None and len(t.record.coherence)][-1]
    assert last.record is not None
    assert min(last.record.coherence.values()) > 0.9

    from ema_pipeline.raw_folder import check_raw

    (judged,) = check_raw(folder).values()
    assert {h.file for h in judged} == {f.name for f in files}


def test_a_file_that_grows_is_judged_again(source: Path, tmp_path: Path) -> None:
    """Half of it is no good; the whole is; it is listed once."""
    folder = _channels(source, tmp_path / "live")
    file = min(source.glob("m1*.csv"))
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)

    def write() -> None:
        (folder / file.name).write_text("".join(lines[:40]), encoding="utf-8")
        time.sleep(1.4)
        shutil.copy(file, folder / file.name)

    told = _watched(folder, write, 2)
    assert [t.good for t in told] == [False, True]
    assert (folder / "test.toml").read_text(encoding="utf-8").count(file.name) == 1


def test_points_are_asked_for_in_turn(source: Path, tmp_path: Path) -> None:
    """Files with names that say nothing belong to the point that was asked for."""
    folder = _channels(source, tmp_path / "live")
    session = Session(folder, ("m1.x", "m3.x"), wanted=2)
    from ema_pipeline.watch.arrivals import Arrival

    lines = []
    for k, file in enumerate([*sorted(source.glob("m1*.csv"))[:2], *sorted(source.glob("m3*.csv"))[:2]]):
        path = folder / f"run{k}.csv"
        shutil.copy(file, path)
        lines.append(session.take(Arrival(path, time.time())).text)
    assert "strike m1.x again" in lines[0]
    assert "m1.x is done, next: m3.x" in lines[1]
    assert "all points are done" in lines[3]
    assert session.done


def test_a_copy_of_a_hit_is_no_hit(source: Path, tmp_path: Path) -> None:
    """A hit that was saved twice is struck again; the file itself may be judged as often as it changes."""
    folder = _channels(source, tmp_path / "live")
    session = Session(folder, ("m1.x",), wanted=2)
    first, second = sorted(source.glob("m1*.csv"))[:2]

    def take(file: Path, name: str) -> Told:
        shutil.copy(file, folder / name)
        return session.take(Arrival(folder / name, time.time()))

    assert take(first, "m1_x_1.csv").good
    copy = take(first, "m1_x_2.csv")
    assert not copy.good
    assert "holds the same force as m1_x_1.csv" in copy.text
    assert "strike m1.x again" in copy.text
    assert take(first, "m1_x_1.csv").good
    assert "all points are done" in take(second, "m1_x_3.csv").text


def test_a_copy_of_a_hit_on_another_point_is_no_hit(source: Path, tmp_path: Path) -> None:
    """The file of one point, saved once more under the name of another."""
    folder = _channels(source, tmp_path / "live")
    session = Session(folder, ("m1.x", "m3.x"), wanted=1)
    first = min(source.glob("m1*.csv"))
    said = []
    for name in ("m1_x_1.csv", "m3_x_1.csv"):
        shutil.copy(first, folder / name)
        said.append(session.take(Arrival(folder / name, time.time())))
    assert [t.good for t in said] == [True, False]
    assert "holds the same force as m1_x_1.csv, bit for bit" in said[1].text
    assert said[1].text.endswith("strike m3.x again")


def test_a_file_that_stays_empty_is_told(source: Path, tmp_path: Path) -> None:
    """Not at once: a file that is filled within two seconds is judged as any other."""
    folder = _channels(source, tmp_path / "live")
    file = min(source.glob("m1*.csv"))

    def write() -> None:
        (folder / "m3_x_1.csv").touch()
        (folder / file.name).touch()
        time.sleep(0.5)
        shutil.copy(file, folder / file.name)

    told = _watched(folder, write, 2)
    assert [(t.file, t.good) for t in told] == [(file.name, True), ("m3_x_1.csv", False)]
    assert told[1].text == "✗ m3_x_1.csv: is empty; copy or export it again"


def test_a_blow_on_another_point_than_was_asked_for_is_told(source: Path, tmp_path: Path) -> None:
    folder = _channels(source, tmp_path / "live")
    session = Session(folder, ("m1.x", "m3.x"), wanted=3)
    m1, m3 = (sorted(source.glob(f"{m}*.csv"))[:3] for m in ("m1", "m3"))

    def take(file: Path, name: str) -> Told:
        shutil.copy(file, folder / name)
        return session.take(Arrival(folder / name, time.time()))

    for k, file in enumerate(m1):
        assert take(file, f"m1_x_{k}.csv").good
    assert take(m3[0], "m3_x_0.csv").good
    (folder / "other").mkdir()
    wrong = take(_other_blow(m1[0], folder / "other" / "blow.csv"), "m3_x_1.csv")
    assert "! m3_x_1.csv: " in wrong.text
    assert "m3_x_1.csv#1 is listed under m3.x, but like the hits on m1.x" in wrong.text


def _other_blow(file: Path, to: Path) -> Path:
    """A blow on the same point a tenth harder, so that it is no copy."""
    import pandas as pd

    table = pd.read_csv(file)
    table.iloc[:, 1:] *= 1.1
    table.to_csv(to, index=False)
    return to


def test_a_reversed_channel_is_told(source: Path, tmp_path: Path) -> None:
    """One sensor changes its sign from one hit to the next."""
    import pandas as pd

    folder = _channels(source, tmp_path / "live")
    session = Session(folder)
    from ema_pipeline.watch.arrivals import Arrival

    first, second = sorted(source.glob("m1*.csv"))[:2]
    shutil.copy(first, folder / first.name)
    assert session.take(Arrival(folder / first.name, time.time())).good
    table = pd.read_csv(second)
    column = next(c for c in table.columns if "m3" in c)
    table[column] = -table[column]
    table.to_csv(folder / second.name, index=False)
    told = session.take(Arrival(folder / second.name, time.time()))
    assert not told.good
    assert "m3.x is reversed" in told.text


def test_a_dead_channel_is_told(source: Path, tmp_path: Path) -> None:
    """By the check that `ema check` makes; the hit serves for the other channels."""
    import pandas as pd

    from ema_pipeline.watch.arrivals import Arrival

    folder = _channels(source, tmp_path / "live")
    file = min(source.glob("m1*.csv"))
    table = pd.read_csv(file)
    column = next(c for c in table.columns if "m2" in c)
    table[column] = 0.0
    table.to_csv(folder / file.name, index=False)
    told = Session(folder).take(Arrival(folder / file.name, time.time()))
    assert not told.good
    assert "m2" in told.text
    assert told.record is not None
    assert told.record.good == 1


def test_an_overload_is_told(source: Path, tmp_path: Path) -> None:
    """The hammer's channel reaches the end of the converter's range."""
    import pandas as pd

    from ema_pipeline.watch.arrivals import Arrival

    folder = _channels(source, tmp_path / "live")
    file = min(source.glob("m1*.csv"))
    table = pd.read_csv(file)
    column = next(c for c in table.columns if "hammer" in c)
    table[column] = (table[column] * 20.0 / table[column].max()).clip(upper=10.0)
    table.to_csv(folder / file.name, index=False)
    told = Session(folder).take(Arrival(folder / file.name, time.time()))
    assert not told.good
    assert "overload" in told.text


def test_the_command_judges_what_is_there(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From the command line, JSON by line, until nothing more comes."""
    folder = _channels(source, tmp_path / "live")
    for file in sorted(source.glob("m1*.csv"))[:2]:
        shutil.copy(file, folder / file.name)
    code, said, _ = ema(capsys, "watch", folder, "--idle", "1", "--json")
    assert code == 0
    told = [json.loads(line) for line in said.splitlines()]
    assert [t["good"] for t in told] == [True, True]
    assert told[1]["coherence"].keys() == {"m1.x", "m2.x", "m3.x"}
    code, said, _ = ema(capsys, "watch", folder, "--idle", "1", "--hits", "2", "--sound")
    assert "m1.x is done" in said
    assert "Still to strike" not in said
    _, said, _ = ema(capsys, "watch", folder, "--idle", "1", "--point", "m1.x", "--point", "m4.x")
    assert "Still to strike: m1.x (2 of 3 good hits), m4.x (0 of 3 good hits)." in said
    assert ema(capsys, "run", folder, "--out", tmp_path / "out", "-q")[0] == 0


def test_a_folder_without_channels_is_said_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line."""
    for folder in (tmp_path, tmp_path / "x"):
        code, _, err = ema(capsys, "watch", folder, "--idle", "1")
        assert code == 1
        assert len(err.splitlines()) == 1


@pytest.mark.parametrize("listed", ["records = []", "records = [\n  # none yet\n]"])
def test_records_in_brackets_are_added_to_in_brackets(source: Path, tmp_path: Path, listed: str) -> None:
    """A table at the end would make the file unreadable."""
    folder = _channels(source, tmp_path / "live")
    text = (folder / "test.toml").read_text(encoding="utf-8")
    (folder / "test.toml").write_text(listed + "\n" + text, encoding="utf-8")
    files = sorted(source.glob("*.csv"))[:2]
    for file in files:
        shutil.copy(file, folder / file.name)
    session = Session(folder)
    for file in files:
        assert session.take(Arrival(folder / file.name, time.time())).good
    test = read_description(folder)
    assert [r.file for r in test.records] == [f.name for f in files]
    assert [str(r.impact) for r in test.records] == ["m1.x", "m1.x"]


def test_a_description_that_is_saved_in_another_encoding_meanwhile_is_one_line(
    source: Path, tmp_path: Path
) -> None:
    folder = _channels(source, tmp_path / "live")
    session = Session(folder)
    with (folder / "test.toml").open("ab") as text:
        text.write("# für alle\n".encode("latin-1"))
    file = min(source.glob("*.csv"))
    shutil.copy(file, folder / file.name)
    with pytest.raises(EmaError, match=r"test\.toml: line \d+ is not UTF-8 text; save the file as UTF-8"):
        session.take(Arrival(folder / file.name, time.time()))
