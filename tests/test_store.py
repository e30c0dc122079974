"""The results file keeps what it is given, and survives being killed."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from ema_pipeline import codec
from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.results_folder import LOCK_FILE
from ema_pipeline.run.opening import load_info
from ema_pipeline.store import ALL, Store, _holder


@dataclass(frozen=True)
class Row:
    name: str
    value: float
    kind: Literal["a", "b"]
    dof: Dof
    good: bool


@dataclass(frozen=True)
class Nested:
    rows: tuple[Row, ...]
    note: str


@dataclass(frozen=True)
class Everything:
    text: str
    number: int
    ratio: float
    pole: complex
    flag: bool
    nothing: Nested | None
    something: Nested | None
    array: np.ndarray
    masks: np.ndarray
    band: tuple[float, float]
    words: tuple[str, ...]
    dofs: tuple[Dof, ...]
    deep: tuple[Nested, ...]
    empty: tuple[Row, ...]
    mapping: dict[str, float]
    nested_mapping: dict[str, Nested]
    infinite: float = float("inf")
    defaulted: dict[str, float] = field(default_factory=dict)


def example() -> Everything:
    rows = (
        Row("ä", 1.5, "a", Dof("sun", "x", -1), True),
        Row("b", float("nan"), "b", Dof("p1", "zeta"), False),
    )
    nested = Nested(rows, "two rows")
    return Everything(
        text="m/s²",
        number=7,
        ratio=0.1,
        pole=-3 + 4j,
        flag=False,
        nothing=None,
        something=nested,
        array=np.arange(10_000).reshape(100, 100) * (1 + 2j),
        masks=np.array([True, False]),
        band=(1.0, 2.0),
        words=("", "two words"),
        dofs=(Dof("sun", "x"), Dof("ring", "u", -1)),
        deep=(nested, Nested((), "none")),
        empty=(),
        mapping={"mesh@sun-planet1/fraction": 0.3},
        nested_mapping={"with ring": nested},
    )


def test_what_is_written_is_read_back_equal(tmp_path: Path) -> None:
    before = example()
    with h5py.File(tmp_path / "x.h5", "w") as file:
        codec.write(file, "it", before)
        after = codec.read(file, "it", Everything)
    assert_array_equal(after.array, before.array)
    assert_array_equal(after.masks, before.masks)
    assert repr(after.something) == repr(before.something)  # nan is not equal to itself
    assert repr(after.deep) == repr(before.deep)
    for name in (
        "text",
        "number",
        "ratio",
        "pole",
        "flag",
        "nothing",
        "band",
        "words",
        "dofs",
        "empty",
        "infinite",
    ):
        assert getattr(after, name) == getattr(before, name), name
        assert type(getattr(after, name)) is type(getattr(before, name)), name
    assert after.mapping == before.mapping
    assert repr(after.nested_mapping) == repr(before.nested_mapping)
    assert after.defaulted == {}


def test_plain_hdf5_tools_can_read_scalars_arrays_and_tables(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as file:
        codec.write(file, "it", example())
        assert file["it"].attrs["ratio"] == 0.1
        assert file["it/array"].shape == (100, 100)
        assert file["it/something/rows"]["value"][0] == 1.5
        assert file["it/dofs"][1] == b"-ring.u"


def change_and_fail(store: Store) -> None:
    with store.changing() as file:
        del file["stages/frf/all/result"]
        raise ArithmeticError("half-way")


def test_a_stage_that_fails_half_way_leaves_the_store_as_it_was(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.save("frf", ALL, "key1", "{}", 0.1, result=Nested((), "old"))
    with pytest.raises(ArithmeticError, match="half-way"):
        change_and_fail(store)
    assert store.load("frf", ALL, "result", Nested).note == "old"
    assert store.key("frf") == "key1"
    assert [p.name for p in tmp_path.iterdir()] == ["ema.h5"]


def test_replacing_a_result_again_and_again_does_not_make_the_file_grow(tmp_path: Path) -> None:
    store = Store(tmp_path)
    sizes = []
    for turn in range(6):
        store.save("frf", ALL, f"{turn}", "{}", 0.1, result=np.random.default_rng(turn).normal(size=40_000))
        sizes.append(store.path.stat().st_size)
    assert sizes[-1] < 2.5 * sizes[0]


def test_the_file_states_the_number_of_its_layout(tmp_path: Path) -> None:
    Store(tmp_path).save("hits", ALL, "key", "{}", 0.1, x=1.0)
    with h5py.File(tmp_path / "ema.h5") as file:
        assert file.attrs["format"] == 1


def test_a_store_that_is_no_hdf5_file_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "ema.h5").write_bytes(b"not HDF5 at all")
    with pytest.raises(EmaError, match=r"ema\.h5: is not a readable HDF5 file"):
        Store.existing(tmp_path)


def test_a_second_process_is_kept_out_while_one_writes(tmp_path: Path) -> None:
    code = f"""
from pathlib import Path
from ema_pipeline.store import Store
with Store(Path({str(tmp_path)!r})).lock():
    print("locked")
"""
    with Store(tmp_path).lock():
        blocked = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    free = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "another ema process" in blocked.stderr
    assert free.stdout.strip() == "locked"


@pytest.mark.parametrize(
    ("content", "who"),
    [
        (b"123 lab-pc", "another ema process (number 123 on lab-pc)"),
        (b"12345678901234567890 lab-pc", "another ema process (number 12345678901234567890 on lab-pc)"),
        (b"123456789012345678901 lab-pc", "another ema process"),
        (b"\x1b[2J", "another ema process"),
        (b"\xff\xfe", "another ema process"),
        (b"1 " + 100 * b"a", "another ema process (number 1 on " + 64 * "a" + ")"),
    ],
)
def test_who_holds_the_lock_is_named_only_where_the_lock_file_says_so_plainly(
    tmp_path: Path, content: bytes, who: str
) -> None:
    (tmp_path / "lock").write_bytes(content)
    assert _holder(tmp_path / "lock") == who


def test_workers_of_a_killed_process_die_and_leave_no_lock(tmp_path: Path) -> None:
    code = f"""
import os, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from ema_pipeline.store import Store

def work(seconds):
    os.write(1, f"worker {{os.getpid()}}\\n".encode())  # at once, whoever else writes
    time.sleep(seconds)

with Store(Path({str(tmp_path)!r})).lock(), ProcessPoolExecutor(2, mp_context=get_context("fork")) as pool:
    list(pool.map(work, [60, 60]))
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    lines = [process.stdout.readline() for _ in range(2)]
    assert all(line.startswith("worker ") for line in lines), lines
    workers = [int(line.split()[1]) for line in lines]
    process.kill()
    process.wait()
    process.stdout.close()
    with Store(tmp_path).lock():
        pass
    deadline = time.monotonic() + 5
    while any(_alive(worker) for worker in workers):
        assert time.monotonic() < deadline, "workers outlive their parent"
        time.sleep(0.01)


def _alive(pid: int) -> bool:
    """True for a process that runs; one that is dead and only waits to be counted does not."""
    try:
        return ") Z" not in Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except OSError:
        return False


def test_the_message_about_a_lock_says_who_holds_it(tmp_path: Path) -> None:
    code = f"""
from pathlib import Path
from ema_pipeline.store import Store
with Store(Path({str(tmp_path)!r})).lock():
    pass
"""
    with Store(tmp_path).lock():
        blocked = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert f"number {os.getpid()} on" in blocked.stderr


def test_a_process_killed_while_it_writes_leaves_a_readable_store(tmp_path: Path) -> None:
    Store(tmp_path).save("frf", ALL, "first", "{}", 0.1, result=np.zeros(10))
    code = f"""
import numpy as np
from pathlib import Path
from ema_pipeline.store import Store
store = Store(Path({str(tmp_path)!r}))
print("go", flush=True)
turn = 0
while True:
    turn += 1
    store.save("frf", "all", f"turn {{turn}}", "{{}}", 0.1, result=np.full(20_000, float(turn)))
"""
    rng = np.random.default_rng(1)
    for _ in range(5):
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(float(rng.uniform(0.01, 0.15)))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()
        with Store(tmp_path).reading() as file:
            values = file["stages/frf/all/result"][()]
        assert np.ptp(values) == 0.0
    with Store(tmp_path).lock():
        assert not list(tmp_path.glob(".ema.h5.*.tmp"))


def test_results_of_another_version_are_refused_in_one_line(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.save("frf", ALL, "key", "{}", 0.1, result=Nested((), "old"))
    with store.changing() as file:
        del file["stages/frf/all/result"].attrs["note"]
    with pytest.raises(EmaError, match="written by another version of ema"):
        store.load("frf", ALL, "result", Nested)


def small_stages(store: Store) -> None:
    """A store with the kinds of content that stages write: arrays, tables, texts, samples."""
    store.save(
        "frf", ALL, "key", "{}", 0.1, result=example(), samples=np.random.default_rng(1).normal(size=9000)
    )
    store.save("ingest", "default", "key", "{}", 0.1, records=iter([example(), example()]))


def read_all(store: Store) -> str:
    """All of the store as text."""
    return repr(
        (
            store.provenance(),
            store.find("frf", ALL, "result", Everything),
            store.find("ingest", "default", "records", tuple[Everything, ...]),
            np.asarray(store.find("frf", ALL, "samples", np.ndarray)).tobytes(),
        )
    )


def fault(store: Store, good: str) -> str | None:
    """What is said about a damaged store; None where unused space was hit, which does no harm."""
    try:
        assert read_all(store) == good
    except EmaError as error:
        return str(error)
    return None


def large(seed: int) -> np.ndarray:
    """More than fits into ema.h5 itself."""
    return np.random.default_rng(seed).normal(size=200_000)


def parts(folder: Path) -> list[str]:
    return sorted(p.name for p in (folder / "stages").glob("*"))


def test_a_large_result_is_a_file_of_its_own_that_hdf5_tools_find_in_its_place(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.save("frf", "default", "0123456789abcdef99", "{}", 0.1, result=large(1))
    assert parts(tmp_path) == ["frf.default.0123456789abcdef.h5"]
    assert store.path.stat().st_size < 100_000
    with h5py.File(store.path) as file:
        assert_array_equal(file["stages/frf/default/result"][()], large(1))
    assert_array_equal(store.load("frf", "default", "result", np.ndarray), large(1))
    assert store.key("frf", "default") == "0123456789abcdef99"
    assert list(store.provenance()) == [("frf", "default")]


def test_saving_one_stage_does_not_touch_the_large_result_of_another(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.save("ingest", ALL, "a", "{}", 0.1, result=large(1))
    (before,) = ((p.stat().st_ino, p.stat().st_mtime_ns) for p in (tmp_path / "stages").iterdir())
    store.save("frf", ALL, "b", "{}", 0.1, result=np.zeros(10))
    (after,) = ((p.stat().st_ino, p.stat().st_mtime_ns) for p in (tmp_path / "stages").iterdir())
    assert before == after


def test_results_of_other_stages_are_dropped_and_those_that_are_kept_stay(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for stage in ("hits", "frf", "modal"):
        store.save(stage, ALL, "key", "{}", 0.1, x=example())
    store.keep(["frf", "report"])
    assert set(store.provenance()) == {("frf", ALL)}
    assert store.find("hits", ALL, "x", Everything) is None
    assert store.load("frf", ALL, "x", Everything).text == example().text
    store.keep(["frf"])
    assert set(store.provenance()) == {("frf", ALL)}


def test_results_copied_from_another_store_need_it_no_more(tmp_path: Path) -> None:
    one, other = Store(tmp_path / "one"), Store(tmp_path / "other")
    for store, factor in ((one, 1.0), (other, 0.0)):
        store.folder.mkdir()
        store.save("own", "default", "key", "{}", 0.1, x=factor)
    one.save("frf", "default", "large", "{}", 0.1, x=large(1))
    one.save("hits", "default", "small", "{}", 0.1, x=np.arange(10.0))
    other.copy_from(one, ["hits", "frf", "modal"], {"default": "part"})
    shutil.rmtree(one.folder)
    assert_array_equal(other.load("frf", "part", "x", np.ndarray), large(1))
    assert_array_equal(other.load("hits", "part", "x", np.ndarray), np.arange(10.0))
    assert {*other.provenance()} == {("own", "default"), ("frf", "part"), ("hits", "part")}
    assert other.load("own", "default", "x", float) == 0.0
    third = Store(tmp_path / "third")
    third.folder.mkdir()
    third.save("frf", "default", "other", "{}", 0.1, x=large(2))
    other.copy_from(third, ["frf"], {"default": "second part"})  # beside the large results that are there
    assert_array_equal(other.load("frf", "second part", "x", np.ndarray), large(2))
    assert_array_equal(other.load("frf", "part", "x", np.ndarray), large(1))


def test_files_of_replaced_and_of_never_linked_results_are_removed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.save("frf", ALL, "old", "{}", 0.1, result=large(1))
    store.save("frf", ALL, "new", "{}", 0.1, result=large(2))
    (tmp_path / "stages" / "modal.all.killed.h5").write_bytes(b"of a run that was killed before the link")
    with store.lock():
        assert parts(tmp_path) == ["frf.all.new.h5"]
        store.save("frf", ALL, "small", "{}", 0.1, result=np.zeros(3))
    assert parts(tmp_path) == []
    assert_array_equal(store.load("frf", ALL, "result", np.ndarray), np.zeros(3))


def test_what_killed_processes_left_behind_is_removed(tmp_path: Path) -> None:
    (tmp_path / ".report.html.123.tmp").touch()
    (tmp_path / ".keeping.123.tmp").mkdir()
    (tmp_path / ".keeping.123.tmp" / "ema.h5").touch()
    with Store(tmp_path).lock():
        assert [path.name for path in tmp_path.iterdir()] == [LOCK_FILE]


def test_a_large_result_that_is_gone_counts_as_not_computed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.save("frf", ALL, "key", "{}", 0.1, result=large(1))
    next((tmp_path / "stages").iterdir()).unlink()
    assert store.key("frf") == ""
    assert store.find("frf", ALL, "result", np.ndarray) is None
    assert store.provenance() == {}


def test_damage_of_a_large_result_is_seen_and_said_in_one_line(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.save("frf", ALL, "key", "{}", 0.1, result=large(1))
    part = next((tmp_path / "stages").iterdir())
    content = bytearray(part.read_bytes())
    content[len(content) // 2] ^= 255
    part.write_bytes(content)
    with pytest.raises(EmaError, match=r"frf\.all\.key\.h5: is damaged .*delete it and run again"):
        store.find("frf", ALL, "result", np.ndarray)


@pytest.mark.parametrize("lure", ["path", "group", "symlink"])
def test_a_link_to_a_file_that_is_no_part_of_the_store_is_refused(tmp_path: Path, lure: str) -> None:
    store = Store(tmp_path / "out")
    store.folder.mkdir()
    store.save("frf", ALL, "key", "{}", 0.1, result=large(1))
    part = next((store.folder / "stages").iterdir())
    part.rename(tmp_path / "secret.h5")
    with h5py.File(store.path, "r+") as file:
        del file["stages/frf/all"]
        if lure == "path":
            file["stages/frf/all"] = h5py.ExternalLink("stages/../../secret.h5", "/")
        elif lure == "group":
            file["stages/frf/all"] = h5py.ExternalLink("stages/x.h5", "/elsewhere")
        else:
            part.symlink_to(tmp_path / "secret.h5")
            file["stages/frf/all"] = h5py.ExternalLink(f"stages/{part.name}", "/")
    with pytest.raises(EmaError, match="leads out of the folder"):
        store.find("frf", ALL, "result", np.ndarray)


def test_a_process_killed_while_it_writes_large_results_leaves_a_whole_store(tmp_path: Path) -> None:
    Store(tmp_path).save("frf", ALL, "first", "{}", 0.1, result=np.full(200_000, 0.5))
    code = f"""
import numpy as np
from pathlib import Path
from ema_pipeline.store import Store
store = Store(Path({str(tmp_path)!r}))
print("go", flush=True)
turn = 0
while True:
    turn += 1
    noise = np.random.default_rng(turn).normal(size=200_000)
    store.save("frf", "all", f"turn {{turn}}", "{{}}", 0.1, result=noise, turn=turn)
"""
    for wait in (0.02, 0.05, 0.1, 0.3):
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(wait)
        process.kill()
        process.wait()
        process.stdout.close()
        store = Store(tmp_path)
        turn = store.find("frf", ALL, "turn", int)
        if turn is not None:
            noise = np.random.default_rng(turn).normal(size=200_000)
            assert_array_equal(store.load("frf", ALL, "result", np.ndarray), noise)
        assert store.key("frf") == ("first" if turn is None else f"turn {turn}")
    with Store(tmp_path).lock():
        assert len(parts(tmp_path)) <= 1
        # "stages" is not there where every process was killed before its first save.
        assert {p.name for p in tmp_path.iterdir()} - {"stages"} == {"ema.h5", ".lock"}


@pytest.mark.parametrize("damaged_bytes", [1, 64, 4096])
def test_damage_anywhere_in_the_file_is_seen_and_said_in_one_line(tmp_path: Path, damaged_bytes: int) -> None:
    store = Store(tmp_path)
    small_stages(store)
    whole, good = store.path.read_bytes(), read_all(store)
    rng = np.random.default_rng(damaged_bytes)
    seen = 0
    for _ in range(40):
        at = int(rng.integers(0, len(whole) - damaged_bytes))
        content = bytearray(whole)
        content[at : at + damaged_bytes] = rng.bytes(damaged_bytes)
        store.path.write_bytes(content)
        error = fault(store, good)
        assert error is None or "delete it and run again" in error or "run it" in error
        seen += error is not None
    assert seen > 20


@pytest.mark.parametrize("lure", ["external", "soft", "raw", "virtual"])
def test_a_store_that_leads_out_of_its_file_is_refused(tmp_path: Path, lure: str) -> None:
    (tmp_path / "secret").write_bytes(b"x" * 64)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["secret"] = np.zeros(8)
    store = Store(tmp_path)
    store.save("frf", ALL, "key", "{}", 0.1, result=np.zeros(8))
    with h5py.File(store.path, "r+") as file:
        group = file["stages/frf/all"]
        del group["result"]
        if lure == "external":
            group["result"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "secret")
        elif lure == "soft":
            group["result"] = h5py.SoftLink("/elsewhere")
        elif lure == "raw":
            group.create_dataset("result", (8,), "f8", external=[(str(tmp_path / "secret"), 0, 64)])
        else:
            layout = h5py.VirtualLayout((8,), "f8")
            layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "secret", (8,))
            group.create_virtual_dataset("result", layout)
    with pytest.raises(EmaError, match="leads out of the file"):
        store.find("frf", ALL, "result", np.ndarray)


def test_a_full_disk_leaves_the_store_as_it_was_and_nothing_else(tmp_path: Path) -> None:
    small_stages(Store(tmp_path))
    before = (tmp_path / "ema.h5").read_bytes()
    # A limit on the size of files fails in the same place as a disk without room, and needs no rights.
    code = f"""
import resource, signal, sys
import numpy as np
from pathlib import Path
from ema_pipeline.errors import EmaError
from ema_pipeline.store import Store
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
store = Store(Path({str(tmp_path)!r}))
limit = int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
made = 0
def arrays():
    global made
    for made in range(100):
        yield np.random.default_rng(made).normal(size=20_000)
try:
    with store.lock():
        store.save("hits", "all", "key", "{{}}", 0.1, result=arrays(), more=np.ones(10))
except EmaError as error:
    print(f"{{made}} EmaError: {{error}}")
"""
    for limit in (100_000, 300_000, 1_000_000, 2_345_678):
        done = subprocess.run(
            [sys.executable, "-c", code, str(limit)], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0
        assert done.stderr == ""
        assert "EmaError" in done.stdout
        assert "cannot be written" in done.stdout
        assert int(done.stdout.split()[0]) < 50  # making what cannot be written would be lost time
        assert (tmp_path / "ema.h5").read_bytes() == before
        assert {p.name for p in tmp_path.iterdir()} == {"ema.h5", ".lock"}


def test_an_array_that_states_more_than_is_stored_is_damage(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.save("frf", ALL, "key", "{}", 0.1, result=np.zeros(8))
    with h5py.File(store.path, "r+") as file:
        del file["stages/frf/all/result"]
        file["stages/frf/all"].create_dataset("result", (1_000_000_000_000,), "f8", chunks=(1024,))
    with pytest.raises(EmaError, match="states 8000000000000 bytes where 0 are stored"):
        store.find("frf", ALL, "result", np.ndarray)


def test_measured_numbers_are_stored_as_they_are_and_empty_ones_packed(tmp_path: Path) -> None:
    """Packing gains a tenth of measured numbers, at ten times the time; of what is mostly empty it gains all."""
    measured = np.random.default_rng(1).normal(size=(3, 2, 65_537)) + 0j
    empty = np.full(measured.shape, np.nan)
    empty[0, 0] = 1.0
    with h5py.File(tmp_path / "x.h5", "w") as file:
        for name, value in (("measured", measured), ("empty", empty), ("short", np.ones((50_000, 3)))):
            codec.write(file, name, value)
            assert_array_equal(codec.read(file, name, np.ndarray), value)
            assert file[name].fletcher32
            assert file[name].id.get_storage_size() < 1.01 * value.nbytes + 4 * file[name].id.get_num_chunks()
        assert file["measured"].compression is None
        assert file["measured"].chunks[:2] == (1, 1)  # one FRF is read without the others
        assert file["empty"].id.get_storage_size() < empty.nbytes / 20
        assert file["short"].id.get_num_chunks() < 10


def test_what_is_left_out_is_not_read(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.save("frf", ALL, "key", "{}", 0.1, result=example())
    found = store.load("frf", ALL, "result", Everything, {"array": np.zeros(0)})
    assert found.array.size == 0
    assert_array_equal(found.masks, example().masks)
    with h5py.File(store.path, "r+") as file:
        del file["stages/frf/all/result/array"]  # so it cannot have been read
    assert store.load("frf", ALL, "result", Everything, {"array": np.zeros(0)}).text == example().text


@pytest.mark.parametrize("mark", [b"OHDR", b"FRHP", b"BTHD"])
def test_damage_that_is_met_while_the_store_is_changed_is_said_in_one_line(
    tmp_path: Path, mark: bytes
) -> None:
    store = Store(tmp_path)
    small_stages(store)
    whole = store.path.read_bytes()
    places = [at for at in range(len(whole)) if whole.startswith(mark, at)]
    assert places
    for at in places:
        content = bytearray(whole)
        content[at + 8 : at + 16] = b"\xff" * 8
        store.path.write_bytes(content)
        for touch in (load_info, save_again):
            with contextlib.suppress(EmaError):  # another error is a fault of the program
                touch(store)


def save_again(store: Store) -> None:
    store.save("frf", ALL, "other", "{}", 0.1, result=np.zeros(3))


def test_a_stage_whose_origin_lacks_something_is_damaged(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.save("frf", ALL, "key", "{}", 0.1, result=np.zeros(3))
    with h5py.File(store.path, "r+") as file:
        del file["stages/frf/all/provenance"].attrs["settings"]
    for read in (store.provenance, lambda: store.key("frf")):
        with pytest.raises(EmaError, match=r"ema\.h5: is damaged \(.*settings is missing\); delete it"):
            read()


@pytest.mark.parametrize("place", ["stages", "stages/frf", "stages/frf/all"])
def test_an_array_in_the_place_of_results_is_damage(tmp_path: Path, place: str) -> None:
    store = Store(tmp_path)
    store.save("frf", ALL, "key", "{}", 0.1, result=np.zeros(3))
    with h5py.File(store.path, "r+") as file:
        del file[place]
        file[place] = np.zeros(3)
    for read in (store.provenance, store.parts, lambda: store.find("frf", ALL, "result", np.ndarray)):
        with contextlib.suppress(EmaError):  # another error is a fault of the program
            read()
    with pytest.raises(
        EmaError, match=r"ema\.h5: is damaged \(/stages.* is an array where results are kept\)"
    ):
        store.key("frf")


def test_a_damaged_dof_is_said_with_the_file(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.save("frf", ALL, "key", "{}", 0.1, dofs=(Dof.parse("sun.x"),), dof=Dof.parse("sun.x"))
    with h5py.File(store.path, "r+") as file:
        file["stages/frf/all"].attrs["dof"] = b"nowhere"
    with pytest.raises(EmaError, match=r"ema\.h5: is damaged \(.*dof 'nowhere' is not of the form"):
        store.find("frf", ALL, "dof", Dof)
