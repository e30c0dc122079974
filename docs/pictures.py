"""Retake the pictures of the report and of the live page from results of the sample.

    .venv/bin/ema run sample_data/hidden_effect --rig planetary
    .venv/bin/python docs/pictures.py results/hidden_effect

Needs Chromium at /usr/bin/chromium. The results are left with the effect that the live page adds.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Page, expect, sync_playwright

FIGURES = Path(__file__).parent / "figures"
SETTLED_MS = 4000
"""Time in which a page has drawn its figures."""
FRAME_MS = 2500


def main(results: Path) -> None:
    """All pictures, the static report first: the live page changes the results."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        report = (results / "report.html").resolve().as_uri()
        for name, width, height in (("report_wide", 1280, 1400), ("report_narrow", 420, 1100)):
            page = opened(browser, report, width, height)
            page.screenshot(path=FIGURES / f"{name}.png")
        live(browser, results)
        browser.close()


def opened(browser: Browser, address: str, width: int, height: int, dark: bool = False) -> Page:
    """A page that has drawn itself."""
    scheme = "dark" if dark else "light"
    page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
    page.goto(address)
    page.wait_for_selector("html[data-ready]", timeout=120_000)
    page.wait_for_timeout(SETTLED_MS)
    return page


def live(browser: Browser, results: Path) -> None:
    """The story on the live page, frame by frame, and its end in dark colours."""
    ema = Path(sys.executable).with_name("ema")
    command = [str(ema), "view", str(results), "--no-browser"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert server.stdout is not None
        address = next(m[0] for line in server.stdout if (m := re.search(r"http://\S+", line)))
        page = opened(browser, address, 1080, 1130)
        page.wait_for_selector("[data-figure=frf][data-state=shown]", timeout=120_000)
        page.wait_for_timeout(SETTLED_MS)
        frames = [page.screenshot()]
        add = page.locator("button.act.add").first
        add.scroll_into_view_if_needed()
        frames.append(page.screenshot())
        add.click()
        page.wait_for_selector("#progress:not([hidden])", timeout=30_000)
        frames.append(page.screenshot())
        expect(page.locator("#page_top h2")).to_contain_text("In the model", timeout=120_000)
        page.wait_for_selector("#cancel", state="hidden", timeout=120_000)
        page.evaluate("window.scrollTo(0, 0)")
        page.wait_for_timeout(SETTLED_MS)
        frames.append(page.screenshot())
        page.emulate_media(color_scheme="dark")
        page.wait_for_timeout(SETTLED_MS)
        page.screenshot(path=FIGURES / "live_dark.png")
        page.emulate_media(color_scheme="light")
        page.locator("button[data-verb=exclude_mode]").nth(2).click()
        expect(page.locator("#moved")).to_be_visible(timeout=120_000)
        expect(page.locator("#status")).to_contain_text("Modes", timeout=120_000)
        page.locator("#choices").screenshot(path=FIGURES / "live_choices.png")
        page.locator("#undo").click()
        expect(page.locator("#status")).to_contain_text("Undone", timeout=60_000)
    finally:
        server.terminate()
    pictures = [Image.open(io.BytesIO(f)).convert("RGB").resize((810, 848)) for f in frames]
    pictures[0].save(
        FIGURES / "live_story.gif", save_all=True, append_images=pictures[1:], duration=FRAME_MS, loop=0, optimize=True
    )  # fmt: skip


if __name__ == "__main__":
    main(Path(sys.argv[1]))
