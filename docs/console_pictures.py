"""Photograph the console in a browser, at each size, into docs/images/console*.

python docs/console_pictures.py [--into FOLDER] [--each FOLDER]

The browser, and what happens to it, are those of tests/browser. Without a GPU a picture of the 3D view takes a second:
it is drawn while the arm rests, or the page would be too busy to drive.
"""

from __future__ import annotations

import argparse
import base64
import io
import sys
import time
from contextlib import closing, suppress
from pathlib import Path

import pytest
from PIL import Image, ImageDraw, ImageFont

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.browser.kit import FLAGS, Bench, Browser, wait_for

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
ACROSS, GAP, LABEL = 1662, 12, 20
"""Width of a sheet, space between pictures, and height of a title, pixels."""
LOADED, REDRAWN = 60, 4
"""Pictures of the 3D view until all of it is there, and after another size."""
TRIES, PATIENCE = 12, 300.0
"""How often a picture is taken until it is good, and s until the 3D view takes too long."""
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


def join(pictures: dict[str, tuple[Image.Image, float]]) -> Image.Image:
    """Return the pictures with their titles, each in its scale, in rows from left to right."""
    sheet = Image.new("RGB", (ACROSS, 8000), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
    left = top = below = 0
    for title, (picture, scale) in pictures.items():
        small = picture.resize((round(picture.width * scale), round(picture.height * scale)), Image.Resampling.LANCZOS)
        if left + small.width > ACROSS:
            left, top = 0, below
        draw.text((left, top), title, "black", font)
        sheet.paste(small, (left, top + LABEL))
        below = max(below, top + LABEL + small.height + GAP)
        left += small.width + GAP
    return sheet.crop((0, 0, ACROSS, below - GAP))


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


def main() -> None:
    """Write the sheets and print their sizes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--into", metavar="FOLDER", type=Path, default=IMAGES)
    parser.add_argument("--each", metavar="FOLDER", type=Path, help="also write each picture there, in its full size")
    args = parser.parse_args()
    pictures = photograph_sizes()
    pictures["1400 x 900"][0].save(args.into / "console.webp", quality=88, method=6)
    for title, (picture, _) in pictures.items():
        if args.each:
            picture.save(args.each / f"{title}.png")
    file = args.into / "console-sizes.webp"
    join(pictures).save(file, quality=80, method=6)
    print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
