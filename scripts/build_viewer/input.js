// Clicks and the pointer on a body, and keys that move between many elements.

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

const STEPS = { ArrowLeft: -1, ArrowUp: -1, ArrowRight: 1, ArrowDown: 1 };

/** Calls `open` with the index of an element that is clicked, or for which Enter or Space is pressed. */
export function rove(elements, open) {
  let current = 0;
  const stopAt = (index) => {
    elements[current].setAttribute("tabindex", -1);
    current = index;
    elements[current].setAttribute("tabindex", 0);
  };
  elements.forEach((element, index) => {
    element.setAttribute("tabindex", index ? -1 : 0);
    element.addEventListener("focus", () => stopAt(index));
    element.addEventListener("click", () => open(index));
    element.addEventListener("keydown", (event) => {
      if (event.altKey || event.ctrlKey || event.metaKey) return;
      const last = elements.length - 1;
      const to = { Home: 0, End: last }[event.key] ?? Math.max(0, Math.min(last, index + (STEPS[event.key] ?? 0)));
      if (event.key === "Enter" || event.key === " ") open(index);
      else if (event.key in STEPS || event.key === "Home" || event.key === "End") elements[to].focus();
      else return;
      event.preventDefault();
    });
  });
}
