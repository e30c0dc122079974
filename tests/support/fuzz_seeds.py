"""Small whole files of every kind that the program reads: what the fuzz tests damage."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import h5py
import numpy as np
import scipy.io
from ingest_example import DESCRIPTION, RATE, hammer_test, write_csv, write_uff
from nptdms import ChannelObject, TdmsWriter
from scipy.io import wavfile

SAMPLES = 128
DATA = {name: samples[:SAMPLES] for name, samples in hammer_test().items()}

LVM_HEAD = """LabVIEW Measurement\t
Separator\tTab
Decimal_Separator\t.
X_Columns\tOne
***End_of_Header***\t

Channels\t2\t
Samples\t{n}\t{n}
Y_Unit_Label\tN\tm/s^2
Delta_X\t{dt}\t{dt}
***End_of_Header***\t\t
X_Value\thammer\ttip\tComment
"""

RIG_DERIVED = """base = "planetary"
name = "mine"
[geometry]
planets = 3
[parameters]
carrier_mass = { value = 1.50, unit = "kg", tolerance = 0.02 }
sun_planet_mesh_stiffness = { value = 2e7, unit = "N/m", min = 1e6, max = 1e9, free = true }
"""

MODES = """schema = 1
title = "two modes"
[no_ring]
frequency_hz = [62.5, 85.7]
frequency_std_hz = [0.1, 0.2]
damping_ratio = [0.01, 0.02]
band_hz = [10.0, 200.0]
"""

MODES_TABLE = """configuration,frequency_hz,frequency_std_hz,damping_ratio
no_ring,62.5,0.1,0.01
no_ring,85.7,0.2,0.02
"""

PIPELINE = """stages = ["ingest", "hits", "frf", "modal", "report"]
[ingest]
largest_mb = 100.0
[modal.identify]
engine = "lscf"
[diagnose]
folds = 3
"""


def tomls(docs: Path) -> dict[str, str]:
    """Texts by kind: what ``test.toml``, rig files, tables of modes and pipelines look like."""
    page = (docs / "adding_a_rig.md").read_text(encoding="utf-8")
    elements = page.split("```toml\n")[2].split("```")[0]
    test = DESCRIPTION.replace("{file}", "hit1.csv")
    kinds = {"rig": RIG_DERIVED, "modes": MODES, "table": MODES_TABLE, "pipeline": PIPELINE}
    return {"test": test, "elements": elements, **kinds}


def write_records(folder: Path) -> dict[str, bytes]:
    """Record files of every format, as bytes by name."""
    write_csv(folder / "a.csv", DATA)
    write_uff(folder / "binary.uff", DATA, binary=True)
    write_uff(folder / "ascii.uff", DATA, binary=False)
    rows = [f"{i / RATE:.9f}\t{DATA['hammer'][i]:.6g}\t{DATA['tip'][i]:.6g}" for i in range(SAMPLES)]
    head = LVM_HEAD.format(n=SAMPLES, dt=1 / RATE)
    (folder / "a.lvm").write_text(head + "\n".join(rows) + "\n", encoding="utf-8")
    (folder / "blanks.txt").write_text("hammer tip\n" + "\n".join(r.partition("\t")[2] for r in rows))
    both = np.column_stack(list(DATA.values())).astype(np.float32)
    wavfile.write(folder / "float.wav", int(RATE), both)
    wavfile.write(folder / "whole.wav", int(RATE), (both * 100).astype(np.int16))
    scipy.io.savemat(folder / "plain.mat", {**DATA, "Fs": RATE})
    scipy.io.savemat(folder / "packed.mat", {"rec": {**DATA, "dt": 1 / RATE}}, do_compression=True)
    _write_hdf5(folder / "old.h5", "earliest", {})
    _write_hdf5(folder / "new.h5", "latest", {"compression": "gzip", "fletcher32": True, "chunks": (64,)})
    _write_mat_73(folder / "newer.mat")
    with TdmsWriter(folder / "a.tdms") as writer:
        properties = {"wf_increment": 1 / RATE, "unit_string": "N"}
        writer.write_segment([ChannelObject("g", n, x, properties=properties) for n, x in DATA.items()])
    (folder / "a.csv.gz").write_bytes(gzip.compress((folder / "a.csv").read_bytes(), mtime=0))
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def _write_hdf5(path: Path, version: str, how: dict[str, object]) -> None:
    with h5py.File(path, "w", libver=version) as file:
        file.attrs["fs"] = RATE
        for name, samples in DATA.items():
            file.create_dataset(f"measurement/{name}", data=samples, **how)
            file[f"measurement/{name}"].attrs["unit"] = "N" if name == "hammer" else "m/s^2"
        file["measurement"].attrs["names"] = list(DATA)


def _write_mat_73(path: Path) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, samples in {**DATA, "fs": np.array([RATE])}.items():
            file[name] = samples.reshape(1, -1)
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, by hand".ljust(124) + struct.pack("<HH", 0x0200, 0x4D49))
