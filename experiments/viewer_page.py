"""A picture of the page on which a car drives live, docs/viewer.png.

    python -m experiments.viewer_page [--steps 38] [--picture docs/viewer.png]

The car drives to its first obstacle; a browser without a window then opens the page. It
needs `pip install playwright pillow` and the browser Chromium, whose path is looked up.
"""

import argparse
import io
import shutil
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

import sfkd_jax
from sfkd_jax import viewer

SIZE = {"width": 1280, "height": 720}
LOADS_S = 12.0
"""Time in which the page is drawn, without a graphics card."""
ENV = np.array([0.5, 4.0])
"""Friction [-] and side wind [m/s] of the picture."""
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def screenshot(page_address):
    """Return the picture of a page, as the browser draws it."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=FLAGS
        )
        page = browser.new_page(viewport=SIZE)
        page.goto(page_address)
        page.wait_for_timeout(1e3 * LOADS_S)
        # A note that there is no graphics card.
        for notice in page.locator(".mantine-Notification-closeButton").all():
            notice.click()
        page.wait_for_timeout(1e3)
        content = page.screenshot()
        browser.close()
    return Image.open(io.BytesIO(content)).convert("RGB")


def main(steps, picture):
    """Drive, draw the page, and return what `viewer.show` does."""
    drive = viewer.live_drive(sfkd_jax.load("kinematic_path"))
    user_input = drive.first_input._replace(env=ENV)
    with viewer.served(0) as server:
        shown = viewer.show(server, drive, user_input=user_input, steps=steps)
        image = screenshot(shown["address"])
    image.save(picture, optimize=True)
    return shown | {"picture": str(picture)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=38, help="control steps before it")
    parser.add_argument("--picture", type=Path, default=Path("docs/viewer.png"))
    print(main(**vars(parser.parse_args())))
