// The cameras of the bodies on a page, which move together while they are linked.

import { moveByKey } from "./body.js";

export class Cameras {
  #bodies;
  #direction;
  #linked;
  #onMove;
  #leader = null; // the body that the other bodies follow at the moment

  untouched = true; // whether the bodies are still seen as after the last reset

  /** `linked` is the check box that links the cameras. `onMove` is called when a camera moves. */
  constructor(bodies, { direction, linked, onMove }) {
    this.#bodies = bodies;
    this.#direction = direction;
    this.#linked = linked;
    this.#onMove = onMove;
    for (const body of bodies) {
      body.controls.addEventListener("change", () => this.#follow(body));
      body.controls.addEventListener("start", () => (this.untouched = false));
    }
    linked.addEventListener("change", () => bodies.length && this.#follow(bodies[0]));
  }

  /** Shows all visible bodies as a whole, at the same scale and from the first direction. */
  reset() {
    const visible = this.#bodies.filter((body) => body.canvas.clientWidth);
    if (!visible.length) return;
    const distance = Math.max(...visible.map((body) => body.distanceToFit(this.#direction)));
    for (const body of this.#bodies) {
      body.controls.minDistance = distance / 40;
      body.controls.maxDistance = 4 * distance;
      body.lookFrom(this.#direction.clone().setLength(distance));
    }
    this.untouched = true;
  }

  /** Turns, zooms or resets the camera of a body. Returns whether the key does so. */
  onKey(body, key) {
    if (moveByKey(body, key)) this.untouched = false;
    else if (key === "0" || key === "Home") this.reset();
    else return false;
    return true;
  }

  #follow(body) {
    this.#onMove();
    if (!this.#linked.checked || (this.#leader && this.#leader !== body)) return;
    this.#leader = body;
    for (const other of this.#bodies) {
      if (other === body) continue;
      other.camera.position.copy(body.camera.position);
      other.controls.target.copy(body.controls.target);
      other.controls.update();
    }
    this.#leader = null;
  }
}
