"""Files made to crash a reader or to fill memory and time: each a function that writes one."""

from __future__ import annotations

import gzip
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

SIGNAL = np.random.default_rng(1).normal(size=4096)


def gzip_bomb(path: Path) -> None:
    """4 MB that unpack to 4 GB."""
    megabyte = gzip.compress(b"1.0,2.0\n" * 131_072, 9)
    path.write_bytes(megabyte * 4000)  # a gzip file may have many members


def gzip_of_nothing(path: Path) -> None:
    path.write_bytes(gzip.compress(b""))


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def fifo(path: Path) -> None:
    os.mkfifo(path)


def sparse_file(path: Path) -> None:
    with path.open("wb") as file:
        file.write(b"a,b\n1,2\n")
        file.truncate(200_000_000_000)


def long_line(path: Path) -> None:
    path.write_bytes(b"time,hammer\n" + b"9" * 60_000_000)


def many_lines(path: Path) -> None:
    path.write_bytes(b"a\n" + b"1\n" * 10_000_000)


def many_columns(path: Path) -> None:
    names = ",".join(f"c{i}" for i in range(200_000))
    row = ",".join("1" for _ in range(200_000))
    path.write_text(f"{names}\n" + f"{row}\n" * 20)


def mat_header() -> bytes:
    return b"MATLAB 5.0 MAT-file, by hand".ljust(124) + struct.pack("<HH", 0x0100, 0x4D49)


def mat_matrix(rows: int, columns: int, data: bytes, stated: int | None = None) -> bytes:
    flags = struct.pack("<IIII", 6, 8, 6, 0)
    shape = struct.pack("<IIii", 5, 8, rows, columns)
    name = struct.pack("<II", 1, 1) + b"a".ljust(8, b"\0")
    numbers = struct.pack("<II", 9, len(data) if stated is None else stated) + data
    return flags + shape + name + numbers


def mat_packed(content: bytes, stated: int | None = None) -> bytes:
    whole = struct.pack("<II", 14, len(content) if stated is None else stated) + content
    packed = zlib.compress(whole, 9)
    return mat_header() + struct.pack("<II", 15, len(packed)) + packed


def mat_bomb(path: Path) -> None:
    zeros = bytes(256_000_000)
    path.write_bytes(mat_packed(mat_matrix(32_000_000, 1, zeros)))


def mat_bomb_that_lies(path: Path) -> None:
    """Says that it is small; the numbers inside are not."""
    zeros = bytes(256_000_000)
    path.write_bytes(mat_packed(mat_matrix(32_000_000, 1, zeros), stated=1000))


def mat_of_blanks(path: Path) -> None:
    """A text of a thousand million characters, none of which is stored."""
    flags = struct.pack("<IIII", 6, 8, 4, 0)
    shape = struct.pack("<IIii", 5, 8, 1, 1_000_000_000)
    name = struct.pack("<II", 1, 1) + b"a".ljust(8, b"\0")
    content = flags + shape + name + struct.pack("<II", 4, 0)
    path.write_bytes(mat_header() + struct.pack("<II", 14, len(content)) + content)


def h5_sparse_vector(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["hammer"] = SIGNAL
        file.create_dataset("tip", (10_000_000_000,), "f8", chunks=(1024,))


def h5_stray_matrix(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["hammer"] = SIGNAL
        file.create_dataset("image", (60_000, 60_000), "f8", chunks=(64, 64), compression="gzip")


def h5_time_vector(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["hammer"] = SIGNAL
        file.create_dataset("time", (1_000_000_000,), "f8", chunks=(1024,))


def h5_packed_zeros(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("hammer", data=np.zeros(20_000_000), chunks=True, compression="gzip")


def h5_many_datasets(path: Path) -> None:
    with h5py.File(path, "w", libver="latest") as file:
        for i in range(20_000):
            file.create_dataset(f"d{i}", (1,), "f8")


def h5_deep_groups(path: Path) -> None:
    with h5py.File(path, "w") as file:
        group = file
        for _ in range(3000):
            group = group.create_group("g")
        group["hammer"] = SIGNAL


def h5_circle(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["hammer"] = SIGNAL
        file["a/b"] = file["/"]


def h5_virtual_self(path: Path) -> None:
    layout = h5py.VirtualLayout((4096,), "f8")
    layout[:] = h5py.VirtualSource(".", "hammer", (4096,))
    with h5py.File(path, "w", libver="latest") as file:
        file.create_virtual_dataset("hammer", layout)


def h5_external_storage(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("hammer", (4,), "i1", external=[("/etc/hostname", 0, 4)])


def h5_external_link(path: Path) -> None:
    with h5py.File(path.with_suffix(".other"), "w") as other:
        other["hammer"] = SIGNAL
    with h5py.File(path, "w") as file:
        file["hammer"] = h5py.ExternalLink(str(path.with_suffix(".other")), "hammer")


def h5_long_name(path: Path) -> None:
    with h5py.File(path, "w", libver="latest") as file:
        file["n" * 60_000] = SIGNAL


def h5_rate(rate: float) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        with h5py.File(path, "w") as file:
            file["hammer"] = SIGNAL
            file.attrs["dt"] = rate

    return write


def mat_73_table(path: Path) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        file.create_dataset("a", (1, 1), h5py.ref_dtype)
        file["a"].attrs["MATLAB_class"] = np.bytes_("cell")
        text = file.create_dataset("#refs#/t", (400_000_000,), "u2", chunks=(1024,))
        text.attrs["MATLAB_class"] = np.bytes_("char")
        file["a"][0, 0] = text.ref
        file.create_dataset("b", (40_000, 40_000), "f8", chunks=(64, 64))
        file["b"].attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, by hand".ljust(124) + struct.pack("<HH", 0x0200, 0x4D49))


def wav_that_lies(path: Path) -> None:
    form = struct.pack("<HHIIHH", 1, 1, 48_000, 96_000, 2, 16)
    path.write_bytes(
        b"RIFF" + struct.pack("<I", 0xFFFFFFF0) + b"WAVE" + b"fmt " + struct.pack("<I", 16) + form
        + b"data" + struct.pack("<I", 0xFFFFFF00) + bytes(2000)
    )  # fmt: skip


def wav_of_many_channels(path: Path) -> None:
    form = struct.pack("<HHIIHH", 1, 60_000, 48_000, 96_000, 60_000 * 2 % 65_536, 16)
    data = bytes(60_000 * 2 * 4)
    path.write_bytes(
        b"RIFF" + struct.pack("<I", 36 + len(data)) + b"WAVE" + b"fmt " + struct.pack("<I", 16) + form
        + b"data" + struct.pack("<I", len(data)) + data
    )  # fmt: skip


def tdms_of_many_objects(path: Path) -> None:
    lead = b"TDSm" + struct.pack("<IIQQ", 0x0E, 4713, 1 << 40, 1 << 40)
    path.write_bytes(lead + struct.pack("<I", 0xFFFFFFFF) + bytes(4000))


def uff_of_many_points(path: Path) -> None:
    lines = ["    -1", "    58", "hammer", *["NONE"] * 4]
    lines += ["    1         1    0         0       NONE         1   3       NONE         1   3"]
    lines += ["         2 999999999         1  0.00000E+00  1.00000E-03  0.00000E+00", *["    17"] * 4]
    path.write_text("\n".join([*lines, "  1.0  2.0", "    -1", ""]))


def lvm_of_many_rows(path: Path) -> None:
    head = "LabVIEW Measurement\t\nSeparator\tTab\nX_Columns\tOne\n***End_of_Header***\t\n\nChannels\t1\t\n"
    head += "Samples\t5\t\nDelta_X\t0.001\t\n***End_of_Header***\t\nX_Value\thammer\tComment\n"
    path.write_text(head + "".join(f"{i / 1000}\t1.0\n" for i in range(200)))


TRAPS: dict[str, Callable[[Path], None]] = {
    "bomb.csv.gz": gzip_bomb,
    "nothing.csv.gz": gzip_of_nothing,
    "device.csv": device,
    "fifo.csv": fifo,
    "sparse.csv": sparse_file,
    "long_line.csv": long_line,
    "many_lines.csv": many_lines,
    "many_columns.csv": many_columns,
    "bomb.mat": mat_bomb,
    "lying_bomb.mat": mat_bomb_that_lies,
    "blanks.mat": mat_of_blanks,
    "table.mat": mat_73_table,
    "sparse.h5": h5_sparse_vector,
    "matrix.h5": h5_stray_matrix,
    "time.h5": h5_time_vector,
    "zeros.h5": h5_packed_zeros,
    "many.h5": h5_many_datasets,
    "deep.h5": h5_deep_groups,
    "virtual.h5": h5_virtual_self,
    "external.h5": h5_external_storage,
    "link.h5": h5_external_link,
    "long_name.h5": h5_long_name,
    "tiny_step.h5": h5_rate(1e-310),
    "large_step.h5": h5_rate(float("inf")),
    "lying.wav": wav_that_lies,
    "channels.wav": wav_of_many_channels,
    "objects.tdms": tdms_of_many_objects,
    "points.uff": uff_of_many_points,
    "rows.lvm": lvm_of_many_rows,
}
"""By the name of the file; all must be refused."""
