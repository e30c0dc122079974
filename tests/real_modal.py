"""Readers of the real measurements for the tests of modal identification: raw records to H1, by hand."""

from __future__ import annotations

import tomllib
from pathlib import Path

import h5py
import numpy as np
from simulate_modal import FrfSet, frf_set

from ema_pipeline.dof import Dof

G = 9.80665


def ratio(force: np.ndarray, responses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """H1 over hits and its variance from the scatter: force (hits, n), responses (hits, channels, n)."""
    f, y = np.fft.rfft(force), np.fft.rfft(responses)
    sff = np.sum(np.abs(f) ** 2, axis=0)
    h = np.einsum("hl,hcl->cl", f.conj(), y) / sff
    if len(f) < 2:
        return h, np.full(h.shape, np.nan)
    variance = np.sum(np.abs(y - h * f[:, None]) ** 2, axis=0) / ((len(f) - 1) * sff)
    return h, variance


def aircraft(folder: Path) -> FrfSet:
    """75 points hit once each, 3 accelerometers."""
    frf = []
    for k in range(75):
        with h5py.File(folder / f"run{k:02d}.h5") as file:
            force = np.asarray(file["hammer"], float)
            responses = (
                np.array([file[name] for name in ("wing", "horizontal_tail", "vertical_tail")], float) * G
            )
        force = np.where(np.arange(4096) < 24, force - force[-500:].mean(), 0.0)  # the blow lasts 10 samples
        frf.append(ratio(force[None], responses[None])[0])
    matrix = np.array(frf).transpose(1, 0, 2)
    frequency = np.fft.rfftfreq(4096, 1 / 512)
    names = {
        0: "wing",
        1: "horizontal_tail",
        2: "vertical_tail",
        **{3 + k: f"point{k:02d}" for k in range(75)},
    }
    return frf_set(
        frequency, matrix, [0, 1, 2], list(range(3, 78)), band_hz=(0.0, 200.0), names=names, delay=5 / 512
    )


def aircraft_analyser(folder: Path) -> FrfSet:
    """The analyser's own averaged FRFs of the same points."""
    data = np.load(folder / "analyser_frf.npz")
    names = {
        0: "wing",
        1: "horizontal_tail",
        2: "vertical_tail",
        **{3 + k: f"point{k:02d}" for k in range(75)},
    }
    matrix = data["H_g_per_N"].astype(complex).transpose(1, 0, 2) * G
    return frf_set(
        data["f_Hz"],
        matrix,
        [0, 1, 2],
        list(range(3, 78)),
        band_hz=(0.0, 200.0),
        names=names,
        decay_rad_s=0.13889,
    )


def five_hits(folder: Path) -> FrfSet:
    """Five hits on one point, one response."""
    rows = [np.genfromtxt(folder / f"hit{k}.csv", delimiter=",", skip_header=1) for k in range(1, 6)]
    n = min(len(r) for r in rows)
    force = np.array([r[:n, -2] for r in rows])
    response = np.array([r[:n, -1] for r in rows])
    h, v = ratio(force, response[:, None])
    return frf_set(
        np.fft.rfftfreq(n, 1 / 25600),
        h[:, None],
        [0],
        [0],
        variance=v[:, None],
        n_hits=5,
        band_hz=(0.0, 5000.0),
    )


def uff58b(path: Path) -> dict[str, np.ndarray]:
    """Channels of a binary UFF 58 file, by their first id line."""
    raw = path.read_bytes()
    out, at = {}, 0
    while (at := raw.find(b"    58b", at)) >= 0:
        lines, end = [], at
        for _ in range(12):
            stop = raw.index(b"\n", end)
            lines.append(raw[end:stop].decode("latin-1").rstrip("\r"))
            end = stop + 1
        n_bytes = 8 * int(lines[7][10:20])  # doubles, whatever the header says
        out[lines[1].strip()] = np.frombuffer(raw[end : end + n_bytes], "<f8").astype(float)
        at = end + n_bytes
    return out


def planetary(folder: Path, high_hz: float = 2000.0) -> FrfSet:
    """A simulated planetary rig in UFF files."""
    with (folder / "test.toml").open("rb") as file:
        test = tomllib.load(file)
    sensitivity = {c["name"]: c["sensitivity_mv"] / 1000 for c in test["channels"]}
    outputs = [c for c in test["channels"] if c["quantity"] != "force"]
    hits: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for record in test["records"]:
        signal = uff58b(folder / record["file"])
        values = {k: v / sensitivity[k] for k, v in signal.items() if k in sensitivity}
        pair = (values["hammer"], np.array([values[c["name"]] for c in outputs]))
        hits.setdefault(record["impact"], []).append(pair)
    frfs, variances = [], []
    delay = []
    for pairs in hits.values():
        force = np.array([f - np.median(f) for f, _ in pairs])
        peak = int(np.argmax(np.abs(force[0])))
        window = np.zeros(force.shape[1])
        window[max(0, peak - 30) : peak + 40] = 1.0
        resp = np.array([y - y[:, -200:].mean(axis=1, keepdims=True) for _, y in pairs])
        h, v = ratio(force * window, resp)
        frfs.append(h)
        variances.append(v)
        delay.append(peak / test["sample_rate_hz"])
    frf = np.array(frfs).transpose(1, 0, 2)
    n = force.shape[1]
    points = [Dof.parse(c["dof"]) for c in outputs]
    ins = [Dof.parse(i) for i in hits]
    base = frf_set(
        np.fft.rfftfreq(n, 1 / test["sample_rate_hz"]), frf, list(range(len(points))), list(range(len(ins))),
        variance=np.array(variances).transpose(1, 0, 2), n_hits=2, band_hz=(0.0, high_hz),
        delay=float(np.mean(delay)),
    )  # fmt: skip
    return FrfSet(**{**base.__dict__, "outputs": tuple(points), "inputs": tuple(ins)})
