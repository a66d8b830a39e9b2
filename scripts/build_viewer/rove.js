// Keyboard access to many elements with one stop of the Tab key: arrow keys move between the elements.

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
