// Clicks on a body and the pointer above a body.

const CLICK_TOLERANCE = 5; // the most pixels that the pointer moves between press and release of a click

/**
 * Calls `click(event)` for clicks that turn nothing. Calls `hover(event)` at most once per frame while the mouse
 * moves, and `hover(null)` when it leaves, as long as `hovers()` returns true.
 */
export function watchPointer({ canvas }, { click, hover, hovers }) {
  let pressed = { x: 0, y: 0 };
  canvas.addEventListener("pointerdown", (event) => (pressed = { x: event.clientX, y: event.clientY }));
  canvas.addEventListener("click", (event) => {
    if (Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) <= CLICK_TOLERANCE) click(event);
  });

  let latest = null; // the latest position of the pointer that has not been handled yet
  canvas.addEventListener("pointermove", (event) => {
    if (!hovers() || event.buttons || event.pointerType === "touch") return;
    if (!latest) {
      requestAnimationFrame(() => {
        if (latest && hovers()) hover(latest);
        latest = null;
      });
    }
    latest = event;
  });
  canvas.addEventListener("pointerleave", () => {
    latest = null;
    if (hovers()) hover(null);
  });
}
