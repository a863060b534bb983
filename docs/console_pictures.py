"""Photograph the console in a browser, at each size and in each state of trouble, into docs/images/console*.

python docs/console_pictures.py [--into FOLDER] [--each FOLDER] [sizes] [trouble]

The browser, and what happens to it, are those of tests/browser. Without a GPU a picture of the 3D view takes a second:
it is drawn while the arm rests, or the page would be too busy to drive.
"""

from __future__ import annotations

import argparse
import base64
import io
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from PIL import Image, ImageDraw, ImageFont

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.browser.cable import Cable
from tests.browser.kit import FLAGS, Bench, Browser, wait_for
from tests.browser.moves import (
    TROUBLE,
    clear_trip,
    drive_left,
    end_trouble,
    frozen_console,
    let_go_of_all,
    shows_trouble,
    wait_until_released,
)

IMAGES = Path(__file__).resolve().parent / "images"
SIZES = {
    "1920 x 1080": (1920, 1080, False, 0.62),
    "390 x 844": (390, 844, True, 0.8),
    "1400 x 900": (1400, 900, False, 0.55),
    "1024 x 768": (1024, 768, False, 0.645),
    "844 x 390": (844, 390, True, 0.9),
    "1400 x 900, dark": (1400, 900, False, 0.55),
}
"""Title -> width and height of the page, whether it is a touch screen, and the scale on the sheet."""
WINDOW, WINDOW_SCALE = (1280, 800), 0.65
"""Size of the page in trouble, and its scale on the sheet."""
GAP, LABEL, SHEET = 12, 20, 7
"""Space between pictures, and height of a title, pixels; pictures of one sheet."""
LOADED, REDRAWN = 60, 4
"""Pictures of the 3D view until all of it is there, and after another size."""
TRIES, PATIENCE = 12, 300.0
"""How often a picture is taken until it is good, and s until the 3D view takes too long."""
STALE = """return [...document.querySelectorAll("[data-state=stale] canvas")].map((one) => one.dataset.camera).join()
    === "wrist" && document.querySelector("#trip").hidden"""
"""Whether the picture of that camera is old, and nothing else is wrong."""
WRONG = """return [...document.querySelectorAll(".banner, .camera[data-state=stale]")]
    .some((one) => one.checkVisibility())"""
"""Whether a banner is shown, or an old picture."""
GATE = """
if (self !== top) {
  const real = requestAnimationFrame.bind(self);
  requestAnimationFrame = function draw(call) {
    if (top.drawn3d < top.wanted3d) real(call);
    else setTimeout(() => draw(call), 50);
  };
  const count = () => { top.drawn3d += 1; requestAnimationFrame(count); };
  addEventListener("load", count);
} else {
  Object.assign(window, { drawn3d: 0, wanted3d: 0 });
  const read = WebGL2RenderingContext.prototype.getParameter;
  WebGL2RenderingContext.prototype.getParameter = function (key) {
    return [0x1f01, 0x9246].includes(key) ? "GPU" : read.call(this, key); // the renderer's names
  };
}"""
"""Draws the 3D view when it is asked for, as if a GPU did."""


def draw_3d(page: Browser, pictures: int) -> None:
    """Let the 3D view draw so many pictures."""
    page.run("window.wanted3d = drawn3d + arguments[0]", pictures)
    wait_for(lambda: page.run("return drawn3d >= wanted3d"), "the 3D view", PATIENCE)


def set_control(page: Browser, wanted: bool) -> None:
    """Take or release control: while no page has it, one that is busy with drawing stops nothing."""

    def has_it() -> bool:
        if page.facts.get("driving") is not wanted:
            page.run("document.querySelector('#lease').click()")
            time.sleep(0.5)
        return page.facts.get("driving") is wanted

    wait_for(has_it, "the control")


def photograph(page: Browser) -> Image.Image:
    """Return what the window shows."""
    data = base64.b64decode(page.cdp("Page.captureScreenshot", format="png")["data"])
    return Image.open(io.BytesIO(data)).convert("RGB")


def has_drawn(page: Browser) -> bool:
    """Return whether there is something in the 3D view."""
    at = page.place(".stage")
    return len(photograph(page).crop((at["left"], at["top"], at["right"], at["bottom"])).getcolors(1 << 20)) > 1000


def photograph_size(page: Browser) -> Image.Image:
    """Return the page in control of the arm, with everything in the picture."""
    for _ in range(TRIES):
        time.sleep(0.5)
        draw_3d(page, REDRAWN)
        if not has_drawn(page):
            continue  # the 3D view was still to hear of its size
        set_control(page, True)
        with suppress(pytest.fail.Exception):
            wait_for(lambda: page.text("#deadman") == "released" and not page.run(WRONG), "rest, and live pictures")
            page.run("log.replaceChildren()")  # drawing without a GPU left it, and nothing else happened
            return photograph(page)
        set_control(page, False)
    raise SystemExit("this computer is too busy")


def join(pictures: dict[str, tuple[Image.Image, float]], across: int) -> Image.Image:
    """Return the pictures with their titles, each in its scale, in rows that are so wide at most, pixels."""
    sheet = Image.new("RGB", (across, 8000), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
    left = top = below = 0
    for title, (picture, scale) in pictures.items():
        small = picture.resize((round(picture.width * scale), round(picture.height * scale)), Image.Resampling.LANCZOS)
        if left + small.width > across:
            left, top = 0, below
        draw.text((left, top), title, "black", font)
        sheet.paste(small, (left, top + LABEL))
        below = max(below, top + LABEL + small.height + GAP)
        left += small.width + GAP
    return sheet.crop((0, 0, across, below - GAP))


def photograph_sizes() -> dict[str, tuple[Image.Image, float]]:
    """Return the console with the 3D view at each size, in control."""
    drawing = "--use-angle=gl-egl", "--ignore-gpu-blocklist", "--disable-gpu-compositing"
    flags = [flag for flag in FLAGS if flag != "--disable-gpu"] + list(drawing)
    found = {}
    with (
        closing(Bench(cameras=True, viewer="3d")) as bench,
        closing(Browser(flags=flags)) as page,
    ):
        page.cdp("Page.addScriptToEvaluateOnNewDocument", source=GATE)
        page.size(320, 300)  # where there is little to draw
        page.open(bench.link)
        page.wait_driving()
        set_control(page, False)
        draw_3d(page, LOADED)
        for title, (width, height, touch, scale) in SIZES.items():
            page.size(width, height, touch)
            if "dark" in title:
                page.click("#theme")
            found[title] = photograph_size(page), scale
            set_control(page, False)
    return found


def photograph_trouble() -> dict[str, tuple[Image.Image, float]]:
    """Return the console in each state of trouble, by the rows of the table in docs/console.md."""
    found = {}
    with closing(Bench(cameras=True)) as bench, closing(Browser(*WINDOW)) as page, ExitStack() as at_end:
        link = urlsplit(bench.link)
        cable = at_end.enter_context(closing(Cable(link.port or 0)))

        def cut(seconds: float) -> None:
            cable.cut()
            time.sleep(seconds)
            cable.mend()

        def drive() -> None:
            page.open(f"http://127.0.0.1:{cable.port}/#{link.fragment}")
            page.wait_driving()
            wait_until_released(bench)
            clear_trip(bench, page)
            drive_left(bench, page, 0.12)

        def take(what: str, cause: Callable[[], object], shown: Callable[[], object] | None = None) -> None:
            for _ in range(TRIES):  # a computer that is too busy stops the arm for that reason
                with suppress(pytest.fail.Exception):
                    drive()
                    cause()
                    wait_for(shown or (lambda: shows_trouble(page, what)), what, 5.0)
                    time.sleep(0.3)
                    found[what] = photograph(page), WINDOW_SCALE
                cable.mend()
                end_trouble(bench, page)
                let_go_of_all(page)
                bench.rig.world.reset("panda")
                if what in found:
                    return
            raise SystemExit(f"not shown: {what}")

        for what, cause in TROUBLE.items():
            take(what, lambda cause=cause: cause(bench, page))
        take("the network was slow", lambda: cut(0.4))
        take("the connection is lost", cable.cut)
        release = "the dead-man was released"
        take(release, lambda: let_go_of_all(page), lambda: page.text("#waiting") == "Stopped. Hold Space to move.")
        take("a camera was lost", bench.rig.cameras["wrist"].close, lambda: page.run(STALE))
        drive()
        with frozen_console(bench):
            page.click("#stop")
            wait_for(lambda: page.text("#alarm"), "the alarm")
            found["STOP was not confirmed"] = photograph(page), WINDOW_SCALE
        bench.console.close()
        wait_for(lambda: shows_trouble(page, "the program has ended"), "the end")
        found["the program has ended"] = photograph(page), WINDOW_SCALE
    return found


def main() -> None:
    """Write the sheets and print their sizes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=["sizes", "trouble"], help="sizes, trouble; default: both")
    parser.add_argument("--into", metavar="FOLDER", type=Path, default=IMAGES)
    parser.add_argument("--each", metavar="FOLDER", type=Path, help="also write each picture there, in its full size")
    args = parser.parse_args()
    across = 2 * round(WINDOW[0] * WINDOW_SCALE) + GAP
    for name in args.what:
        pictures = {"sizes": photograph_sizes, "trouble": photograph_trouble}[name]()
        if name == "sizes":
            pictures["1400 x 900"][0].save(args.into / "console.webp", quality=88, method=6)
        for title, (picture, _) in pictures.items():
            if args.each:
                picture.save(args.each / f"{title}.png")
        titles = list(pictures)
        for k in range(0, len(titles), SHEET):
            file = args.into / f"console-{name}{k // SHEET + 1 if len(titles) > SHEET else ''}.webp"
            join({title: pictures[title] for title in titles[k : k + SHEET]}, across).save(file, quality=80, method=6)
            print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
