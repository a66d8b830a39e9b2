"""Opens an interactive page in headless Chromium, and takes a screenshot.

The picture of a pair shows the wavelets around one vertex. The picture of a collection shows the whole page.
Run `python scripts/draw_page.py PAGE.html PICTURE.png`. The script needs the extra `test`, Chromium and
chromedriver.
"""

from __future__ import annotations

import argparse
import io
import shutil
import tempfile
from pathlib import Path

from jaxsmw.runtime.files import atomic_write

WIDTH, HEIGHT = 1280, 850


def main() -> None:
    """Open the page, and write a screenshot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("page", metavar="PAGE.html", type=Path)
    parser.add_argument("picture", metavar="PICTURE.png", type=Path)
    parser.add_argument(
        "--vertex", type=int, default=4127, help="vertex of the source (default: %(default)s)"
    )
    parser.add_argument(
        "--scale", type=int, default=4, help="scale of the wavelet, 0 for the widest (default: %(default)s)"
    )
    parser.add_argument("--height", type=int, default=HEIGHT, help="in pixels (default: %(default)s)")
    options = parser.parse_args()
    from PIL import Image
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    with tempfile.TemporaryDirectory() as directory:
        settings = webdriver.ChromeOptions()
        settings.binary_location = shutil.which("chromium") or ""
        for argument in (
            "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
            "--hide-scrollbars", f"--user-data-dir={directory}",
        ):  # fmt: skip
            settings.add_argument(argument)
        browser = webdriver.Chrome(options=settings, service=Service(shutil.which("chromedriver")))
        try:
            size = {"width": WIDTH, "height": options.height, "deviceScaleFactor": 1, "mobile": False}
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            browser.get(options.page.resolve().as_uri())
            browser.execute_async_script(
                "const [vertex, scale, done] = arguments, slider = document.querySelector('#filter');"
                "if (!slider) return setTimeout(done, 5000);"  # the page of a collection is drawn slowly
                "document.querySelector('input[value=wavelets]').click();"
                "slider.value = scale; slider.dispatchEvent(new Event('input')); jaxsmw.pick(vertex);"
                "requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done, 100)))",
                options.vertex,
                options.scale,
            )
            picture = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
        finally:
            browser.quit()
    with atomic_write(options.picture) as temporary:
        # A picture with 256 dithered colours looks the same as in full colour, and its file is half as large.
        picture.quantize(palette=picture.quantize(256)).save(temporary, format="png", optimize=True)


if __name__ == "__main__":
    main()
