"""Files written one after another into a watched folder, in pieces and with pauses: are all judged right, and when?

python benchmarks/watch_study.py [FILES] [--poll]
"""

from __future__ import annotations

import argparse
import importlib
import random
import sys
import tempfile
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))
write_bench = importlib.import_module("bench").write_bench

from ema_pipeline.watch.live import judged_files  # noqa: E402
from ema_pipeline.watch.session import Session  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="?", type=int, default=40)
    parser.add_argument("--poll", action="store_true")
    given = parser.parse_args()
    root = Path(tempfile.mkdtemp(prefix="watch-study-"))
    each = -(-given.files // 2)
    bounces = tuple(f"{p}#{k}" for p in ("m1.x", "m3.x") for k in range(3, each + 1, 7))
    source = write_bench(root, hits=each, format="csv", double_hits=bounces)
    files = sorted(source.glob("*.csv"))[: given.files]
    expected = {f.name: not any(f.stem == f"{b[:2]}_x_150N_{b[5:]}" for b in bounces) for f in files}
    folder = root / "live"
    folder.mkdir()
    (folder / "test.toml").write_text((source / "test.toml").read_text().split("[[records]]")[0])
    ended: dict[str, float] = {}

    def write() -> None:
        chance = random.Random(1)
        for file in files:
            content, at = file.read_bytes(), 0
            pieces = chance.choice([1, 2, 5])
            with (folder / file.name).open("wb") as half:
                for k in range(pieces):
                    to = len(content) * (k + 1) // pieces
                    half.write(content[at:to])
                    half.flush()
                    at = to
                    if k + 1 < pieces:
                        time.sleep(chance.choice([0.05, 0.15, 0.6]))
            ended[file.name] = time.time()
            time.sleep(chance.choice([0.0, 0.5, 1.0]))

    stop, session = threading.Event(), Session(folder, wanted=each)
    writer, last, told = threading.Thread(target=write), {}, 0
    quiet, started = time.monotonic(), False
    for one in judged_files(session, given.poll, stop):
        if not started:
            writer.start()
            started = True
        if one is not None:
            told, quiet = told + 1, time.monotonic()
            last[one.file] = (
                one.record is not None and bool(one.record.good),
                time.time() - ended.get(one.file, time.time()),
            )
        if not writer.is_alive() and time.monotonic() - quiet > 2:
            break
    stop.set()
    right = sum(last.get(name, (None, 0))[0] == good for name, good in expected.items())
    delays = sorted(delay for _, delay in last.values())
    print(
        f"{right} of {len(files)} files judged right, {told - len(files)} lines for files that were still growing"
    )
    print(
        f"time from a file's end to its line: median {delays[len(delays) // 2]:.2f} s, longest {delays[-1]:.2f} s"
    )


if __name__ == "__main__":
    main()
