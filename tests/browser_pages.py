"""Pages in a browser, which the tests of the viewer share."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.image import imread


class OpenPage:
    """A page in the browser, with a method for each action of a user."""

    def __init__(self, browser: Any, path: Path, *, width: int = 840, height: int = 600) -> None:
        self.browser, self.path = browser, path
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get(path.as_uri())
        self.settle()

    def settle(self) -> None:
        """Waits until the page is drawn."""
        self.browser.execute_async_script(
            "const [done] = arguments, next = requestAnimationFrame; next(() => next(() => setTimeout(done, 30)))"
        )

    def find(self, selector: str) -> Any:
        return self.browser.find_element("css selector", selector)

    def run(self, script: str, *arguments: Any) -> Any:
        return self.browser.execute_script(script, *arguments)

    @property
    def state(self) -> dict[str, Any]:
        return self.run("return jaxsmw.state")

    @property
    def readout(self) -> str:
        return self.find("#readout").text

    def view(self, side: str) -> np.ndarray:
        """The pixels of one canvas."""
        self.settle()
        png = self.find(f"#canvas-{side}").screenshot_as_png
        return np.round(255 * imread(io.BytesIO(png))[..., :3]).astype(int)

    def place(self, side: str, vertex: int) -> tuple[int, int]:
        point = self.run("return jaxsmw.project(arguments[0], arguments[1])", side, vertex)
        return round(point["x"]), round(point["y"])

    def mouse(self) -> Any:
        from selenium.webdriver.common.action_chains import ActionChains

        return ActionChains(self.browser, duration=30)

    def look_away(self) -> None:
        """Moves the pointer off the bodies."""
        self.point_at(3, 3, click=False)

    def point_at(self, x: int, y: int, *, click: bool) -> None:
        actions = self.mouse()
        actions.w3c_actions.pointer_action.move_to_location(x, y)
        if click:
            actions.w3c_actions.pointer_action.click()
        actions.perform()
        self.settle()

    def drag(self, side: str, across: int) -> None:
        canvas = self.find(f"#canvas-{side}")
        self.mouse().move_to_element(canvas).click_and_hold().move_by_offset(across, 0).release().perform()
        self.settle()

    def choose(self, mode: str) -> None:
        self.find(f"input[value={mode}]").click()
        self.settle()


def differ(a: np.ndarray, b: np.ndarray) -> float:
    """Return the share of pixels that differ visibly."""
    return float(np.mean(np.abs(a - b).max(axis=2) > 8)) if a.shape == b.shape else 1.0
