"""A small hammer test in memory and on disk, written without the package's own readers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

RATE = 2048.0
SAMPLES = 2048

DESCRIPTION = """
schema = 1
title = "Beam"
sample_rate_hz = 2048

[[channels]]
name = "hammer"
quantity = "force"
unit = "N"

[[channels]]
name = "tip"
quantity = "acceleration"
unit = "m/s^2"
dof = "tip.z"

[[records]]
file = "{file}"
impact = "tip.z"
"""


def hammer_test(noise: float = 1e-3, seed: int = 1) -> dict[str, NDArray[np.float64]]:
    """A half-sine blow of 1 ms and 100 N, and the 120 Hz, 2 % mode that it sets ringing."""
    rng = np.random.default_rng(seed)
    t = np.arange(SAMPLES) / RATE
    start = 0.05
    force = np.where((t >= start) & (t < start + 1.5e-3), 100 * np.sin(np.pi * (t - start) / 1.5e-3), 0.0)
    w, zeta = 2 * np.pi * 120.0, 0.02
    kernel = np.exp(-zeta * w * t) * np.sin(w * np.sqrt(1 - zeta**2) * t)
    response = np.convolve(force, kernel)[:SAMPLES] * 0.2
    return {
        "hammer": force + noise * 100 * rng.standard_normal(SAMPLES),
        "tip": response + noise * 20 * rng.standard_normal(SAMPLES),
    }


def write_csv(path: Path, data: dict[str, NDArray[np.float64]], with_time: bool = True) -> None:
    """Plain CSV by string formatting."""
    names = list(data)
    lines = [",".join(["time_s", *names] if with_time else names)]
    columns = [data[n] for n in names]
    for i in range(len(columns[0])):
        cells = [f"{c[i]:.17g}" for c in columns]
        lines.append(",".join([f"{i / RATE:.12g}", *cells] if with_time else cells))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def make_test(folder: Path, description: str = DESCRIPTION, file: str = "hit1.csv") -> Path:
    """A folder with a description, and a CSV record if the file is one."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "test.toml").write_text(description.replace("{file}", file), encoding="utf-8")
    if file.endswith(".csv") and not (folder / file).exists():
        write_csv(folder / file, hammer_test())
    return folder


def write_uff(path: Path, data: dict[str, NDArray[np.float64]], binary: bool, **extra: object) -> None:
    """Data set 58 by pyuff's writer."""
    import pyuff

    writer = pyuff.UFF(str(path))
    for node, (name, samples) in enumerate(data.items(), start=1):
        writer.write_sets(
            {
                "type": 58,
                "func_type": 1,
                "rsp_node": node,
                "rsp_dir": 3,
                "ref_node": 1,
                "ref_dir": 3,
                "data": samples,
                "x": np.arange(samples.size) / RATE,
                "id1": name,
                "binary": int(binary),
                "abscissa_spacing": 1,
                "rsp_ent_name": "NONE",
                "ref_ent_name": "NONE",
                "abscissa_spec_data_type": 17,
                "ordinate_spec_data_type": 0,
                "orddenom_spec_data_type": 0,
                **extra,
            },
            mode="add",
        )
