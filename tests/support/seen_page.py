"""A page in a browser: what it loads and says, and the pixels that it shows."""

import io
from dataclasses import dataclass, field

import numpy as np
from PIL import Image
from playwright.sync_api import Page

BACKGROUND = np.array([243, 245, 247])


@dataclass
class Seen:
    """An open page, what it asked for, and what went wrong in it."""

    page: Page
    requests: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def open(self, address: str) -> None:
        self.page.goto(address)
        self.page.evaluate("window.featuredb.then(() => true)")
        self.frame()

    def frame(self) -> None:
        """Wait until what was asked to be drawn is on the screen."""
        self.page.evaluate(
            "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
        )

    def of_viewer(self, expression: str) -> object:
        return self.page.evaluate(f"window.featuredb.then((viewer) => {expression})")

    def pixels(self) -> np.ndarray:
        """The view (h, w, 3), without the panels."""
        self.frame()
        shot = Image.open(io.BytesIO(self.page.locator("#stage").screenshot())).convert("RGB")
        return np.asarray(shot).astype(int)

    def only(self, *kinds: str) -> None:
        """Show these kinds of things only."""
        for box in self.page.locator("#kinds input").all():
            box.set_checked(box.evaluate("(b) => b.parentElement.textContent.trim()") in kinds)

    def click_photo(self, map_row: int, photo_row: int) -> None:
        at = self.of_viewer(f"viewer.stage.project(viewer.place.maps[{map_row}].photos[{photo_row}].center)")
        self.page.locator("#canvas").click(position={"x": at[0], "y": at[1]})

    def panel(self) -> dict[str, str]:
        """The table's rows of the panel."""
        names = self.page.locator("#panel dt").all_inner_texts()
        return dict(zip(names, self.page.locator("#panel dd").all_inner_texts(), strict=True))


def coloured(pixels: np.ndarray) -> int:
    """How many pixels are not the background."""
    return int((np.abs(pixels - BACKGROUND).max(axis=2) > 12).sum())


def reddish(pixels: np.ndarray) -> int:
    """How many have the colour that the field's points have, (200, 60, 40)."""
    return int((np.abs(pixels - [200, 60, 40]).max(axis=2) < 60).sum())
