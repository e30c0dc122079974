"""Record files: one writer per format, all by well-kept libraries."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.simulate.settings import RecordFormat

Channels = Mapping[str, NDArray[np.float64]]
"""Volts per channel name, each (n_samples,)."""


def write_uff(path: Path, channels: Channels, sample_rate_hz: float) -> None:
    """UFF dataset 58, binary, one per channel; the name is in id1."""
    import pyuff

    sets = [
        pyuff.prepare_58(
            binary=1,
            func_type=1,
            id1=name,
            id2="volts",
            rsp_node=i,
            rsp_dir=1,
            ref_node=1,
            ref_dir=1,
            abscissa_spacing=1,
            abscissa_min=0.0,
            abscissa_inc=1 / sample_rate_hz,
            abscissa_spec_data_type=17,
            ordinate_spec_data_type=0,
            orddenom_spec_data_type=0,
            ordinate_axis_units_lab="V",
            data=volts,
            x=np.arange(len(volts)) / sample_rate_hz,
        )
        for i, (name, volts) in enumerate(channels.items(), 1)
    ]
    path.unlink(missing_ok=True)  # appending is the one mode in which the library keeps every set
    pyuff.UFF(str(path)).write_sets(sets, mode="add")


def write_csv(path: Path, channels: Channels, sample_rate_hz: float) -> None:
    """A header row, a time column and one column per channel."""
    count = len(next(iter(channels.values())))
    table = np.column_stack([np.arange(count) / sample_rate_hz, *channels.values()])
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join(["time", *channels]) + "\n")
        np.savetxt(file, table, delimiter=",", fmt=["%.9f"] + ["%.9g"] * len(channels))


def write_hdf5(path: Path, channels: Channels, sample_rate_hz: float) -> None:
    """One compressed dataset per channel, single precision (finer than the converter's steps)."""
    import h5py

    with h5py.File(path, "w") as file:
        file.attrs["sample_rate_hz"] = sample_rate_hz
        for name, volts in channels.items():
            data = file.create_dataset(
                name, data=volts.astype(np.float32), compression="gzip", compression_opts=9, shuffle=True
            )
            data.attrs["unit"] = "V"


def write_mat(path: Path, channels: Channels, sample_rate_hz: float) -> None:
    """MATLAB version 5, one variable per channel."""
    from scipy.io import savemat

    savemat(path, {**channels, "sample_rate_hz": sample_rate_hz}, do_compression=True)


def write_wav(path: Path, channels: Channels, sample_rate_hz: float) -> None:
    """Floating-point WAV in volts; its channels have numbers, not names."""
    from scipy.io import wavfile

    wavfile.write(path, round(sample_rate_hz), np.column_stack(list(channels.values())).astype(np.float32))


def write_tdms(path: Path, channels: Channels, sample_rate_hz: float) -> None:
    """One group with one channel per sensor and its waveform properties."""
    from nptdms import ChannelObject, TdmsWriter

    properties = {"wf_increment": 1 / sample_rate_hz, "wf_start_offset": 0.0, "unit_string": "V"}
    with TdmsWriter(str(path)) as writer:
        writer.write_segment(
            [
                ChannelObject("test", name, volts.astype(np.float32), properties)
                for name, volts in channels.items()
            ]
        )


WRITERS: dict[RecordFormat, Callable[[Path, Channels, float], None]] = {
    "uff": write_uff,
    "csv": write_csv,
    "hdf5": write_hdf5,
    "mat": write_mat,
    "wav": write_wav,
    "tdms": write_tdms,
}

SUFFIX: dict[RecordFormat, str] = {
    "uff": ".uff",
    "csv": ".csv",
    "hdf5": ".h5",
    "mat": ".mat",
    "wav": ".wav",
    "tdms": ".tdms",
}
