"""A user's own small rig and hammer tests on it, for tests that go through the command line."""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd
import pytest

from ema_pipeline import cli
from ema_pipeline.series.database import SeriesDatabase
from ema_pipeline.simulate import simulate_campaign

RIG = """
name = "bench"
modal_damping_ratio = 0.01

[parameters]
k1 = { value = 1.1e5, unit = "N/m", tolerance = 0.05 }
k2 = { value = 4.0e5, unit = "N/m", tolerance = 0.05 }
k3 = { value = 2.3e5, unit = "N/m", tolerance = 0.05 }
k4 = { value = 5.4e5, unit = "N/m", tolerance = 0.05 }

[[masses]]
at = "m1.x"
value = 2.6

[[masses]]
at = "m2.x"
value = 2.1

[[masses]]
at = "m3.x"
value = 1.2

[[springs]]
name = "k1"
value = "k1"
at = "m1.x"

[[springs]]
name = "k2"
value = "k2"
between = ["m1.x", "m2.x"]

[[springs]]
name = "k3"
value = "k3"
between = ["m2.x", "m3.x"]

[[springs]]
name = "k4"
value = "k4"
at = "m3.x"
"""


def write_bench(folder: Path, name: str = "raw", **settings: object) -> Path:
    """Write ``folder/bench.toml`` and a hammer test of it, ``folder/name``; returns the raw folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "bench.toml").write_text(RIG, encoding="utf-8")
    given = {
        "sensors": ["m1.x", "m2.x", "m3.x"],
        "impacts": ["m1.x", "m3.x"],
        "sample_rate_hz": 1024.0,
        "contact_s": 2e-3,
        "hits": 3,
        "format": "hdf5",
        "seed": 4,
    }
    simulate_campaign(folder / name, str(folder / "bench.toml"), **given | settings)
    return folder / name


def facts_of_series(folder: Path) -> dict[str, pd.DataFrame]:
    """All that a series found out, without where it lies and what it cost."""
    database = SeriesDatabase.existing(folder)
    found = {name: database.table(name) for name in ("tests", "modes", "parameters", "effects")}
    database.close()
    found["tests"] = found["tests"].drop(columns=["results"])
    return found


def ema(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Run the command in this process; returns exit code, stdout and stderr."""
    before = sys.argv
    sys.argv = ["ema", *map(str, arguments)]
    try:
        cli.main()
        code = 0
    except SystemExit as stop:
        code = int(stop.code or 0)
    finally:
        sys.argv = before
    out, err = capsys.readouterr()
    return code, out, err
