// The crosshair on one body, with which keys choose a point of the surface.

const STEP = 8; // pixels

export class Crosshair {
  place = null; // in pixels of the canvas, or null while the crosshair is hidden

  constructor(body, side) {
    this.body = body;
    this.mark = document.getElementById(`crosshair-${side}`);
    body.canvas.addEventListener("blur", () => this.hide());
  }

  hide() {
    this.place = null;
    this.mark.hidden = true;
  }

  #set(x, y) {
    const { canvas } = this.body;
    const within = (value, size) => Math.max(0, Math.min(size - 1, value));
    this.place = { x: within(x, canvas.clientWidth), y: within(y, canvas.clientHeight) };
    this.mark.style.left = `${canvas.offsetLeft + this.place.x}px`;
    this.mark.style.top = `${canvas.offsetTop + this.place.y}px`;
    this.mark.hidden = false;
  }

  #center() {
    this.#set(this.body.canvas.clientWidth / 2, this.body.canvas.clientHeight / 2);
  }

  /** Moves the crosshair to a point of the surface. */
  moveTo(point) {
    const box = this.body.canvas.getBoundingClientRect();
    const { x, y } = this.body.projectPoint(this.body.shape.position(point));
    this.#set(x - box.left, y - box.top);
  }

  /** Moves the crosshair by one step. A hidden crosshair first appears at a point, or in the middle. */
  step([across, down], start) {
    if (!this.place && start) this.moveTo(start);
    if (!this.place) this.#center();
    this.#set(this.place.x + STEP * across, this.place.y + STEP * down);
  }

  /** The point of the surface under the crosshair, or null. */
  get point() {
    if (!this.place) this.#center();
    const box = this.body.canvas.getBoundingClientRect();
    return this.body.pointAt({ clientX: box.left + this.place.x, clientY: box.top + this.place.y });
  }
}
