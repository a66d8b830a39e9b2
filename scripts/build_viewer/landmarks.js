// The landmark mode: points that correspond, which a user places on both bodies, drags, names, loads and saves.

import { Crosshair } from "./crosshair.js";
import { LandmarkExchange } from "./landmark_exchange.js";
import { LandmarkList, other } from "./landmark_list.js";
import { copyCommand, enableControls, fillList, fillName, say, titles } from "./landmark_panel.js";
import { Markers } from "./markers.js";
import { Placement, sendPoint, Suggestions } from "./proposals.js";

const REACH = { mouse: 13, touch: 24 }; // a press at most so many pixels from a marker holds this marker
const DRAG_TOLERANCE = 4; // pixels; shorter movements are clicks

const byId = (id) => document.getElementById(id);
const sides = ["x", "y"];
const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export function startLandmarks(viewer) {
  return new LandmarkMode(viewer);
}

class LandmarkMode {
  active = false;
  list = new LandmarkList();
  #suggestion = null; // a point of the source, with the vertex and its expected error
  #drag = null; // { id, side, start, before, moved }

  constructor(viewer) {
    Object.assign(this, viewer);
    this.placements = { x: new Placement(this.data.x.placement), y: new Placement(this.data.y.placement) };
    this.markers = { x: new Markers(this.bodies.x), y: new Markers(this.bodies.y) };
    this.suggestions = new Suggestions(this.bodies.x.shape);
    this.crosshairs = { x: new Crosshair(this.bodies.x, "x"), y: new Crosshair(this.bodies.y, "y") };
    this.exchange = new LandmarkExchange(this);
    for (const side of sides) this.#listenToBody(side);
    this.#listenToPanel();
    this.#listenToPage();
    this.update();
  }

  // ---- What is shown

  color({ id }) {
    return `hsl(${Math.round(210 + id * 137.5) % 360} 75% 38%)`;
  }

  /** The other point of the open landmark as the map gives it: { side, point }. Null without an open landmark. */
  get ghost() {
    const { open } = this.list;
    if (!open) return null;
    const side = open.x ? "x" : "y";
    const { x, y } = this.bodies;
    const point = sendPoint(side, open[side], x.shape, y.shape, this.currentMap().pointwise);
    return point && { side: other[side], point };
  }

  /** The hollow marker that can be accepted. */
  get proposal() {
    return this.ghost ?? (this.#suggestion && !this.list.open ? { side: "x", point: this.#suggestion.point } : null);
  }

  /** Shows the current landmarks in the bodies and in the panel. */
  update(message) {
    const proposal = this.active ? this.proposal : null;
    for (const side of sides) {
      const { shape } = this.bodies[side];
      const shown = this.list.entries.flatMap((entry, i) => {
        const selected = entry.id === this.list.selected;
        const look = { text: String(i + 1), color: this.color(entry), selected, item: entry };
        if (entry[side]) return { ...look, position: shape.position(entry[side]) };
        if (!selected || proposal?.side !== side) return [];
        return { ...look, position: shape.position(proposal.point), hollow: true, item: "proposal" };
      });
      if (proposal?.side === side && !this.list.open) {
        const look = { text: "?", color: "#1b2230", hollow: true, selected: true, item: "proposal" };
        shown.push({ ...look, position: shape.position(proposal.point) });
      }
      this.markers[side].show(this.active ? shown : []);
      if (!this.active) this.crosshairs[side].hide();
    }
    fillList(this.list, (entry) => this.color(entry));
    enableControls(this.list, { proposal, canSuggest: Boolean(this.#expected()) });
    say("landmark-status", message ?? this.#advice());
    say("landmark-command", this.exchange.command);
    this.draw();
  }

  #advice() {
    const { open, selection } = this.list;
    if (open) {
      return `${open.name}: click the matching point on the ${titles[open.x ? "y" : "x"]}, or accept the hollow marker, the match by the map.`;
    }
    if (this.#suggestion) {
      const { vertex, error } = this.#suggestion;
      return `A landmark helps most near source vertex ${vertex}, where the expected error is ${error.toFixed(3)}. Accept the hollow marker or click near it.`;
    }
    if (selection) return `${selection.name} is complete. Drag its markers to correct it, or click the next point.`;
    return "Click a point on one body, then the matching point on the other body.";
  }

  problem(text = "") {
    say("landmark-problem", text);
  }

  toggle(on = !this.active) {
    this.active = on;
    document.body.dataset.landmarks = on ? "on" : "off";
    byId("landmark-mode").setAttribute("aria-pressed", on);
    byId("landmarks").hidden = !on;
    if (on) this.unpin();
    this.update();
  }

  // ---- Changes

  place(side, point) {
    this.#suggestion = null;
    if (!this.exchange.asks) this.problem();
    this.list.place(side, point);
    this.update();
  }

  accept() {
    const { proposal } = this;
    if (proposal) this.place(proposal.side, proposal.point);
  }

  cancel() {
    const { open } = this.list;
    this.#suggestion = null;
    this.exchange.ask(null);
    if (this.#drag) this.#endDrag(false);
    else {
      // A pair that clicks have begun is dropped. A landmark from a file stays.
      if (open && !open.loaded) this.list.remove(open.id);
      this.list.selected = null;
    }
    this.update();
  }

  remove() {
    this.list.remove(this.list.selected);
    this.update();
  }

  step(by) {
    if (this.#drag) this.#endDrag(false);
    this.list.step(by);
    this.update();
  }

  select(id) {
    this.list.selected = id;
    this.update();
  }

  suggest() {
    const found = this.suggestions.next(this.#expected(), this.list.entries.map(({ x }) => x).filter(Boolean));
    if (this.list.open) this.list.selected = null;
    this.#suggestion = found;
    if (!found) return this.update("There are no further suggestions, because every part of the source is near a landmark or an earlier suggestion.");
    const { x, y } = this.bodies;
    const match = sendPoint("x", found.point, x.shape, y.shape, this.currentMap().pointwise);
    this.turnTowards({ x: found.point, y: match });
    this.update();
  }

  /** The expected errors of the current map, or else of another map, or undefined. */
  #expected() {
    const { expected } = this.data;
    return [this.currentMap(), ...this.maps].map(({ errors }) => errors[expected]).find(Boolean);
  }

  // ---- Mouse and touch

  onClick(side, point) {
    if (this.#pressed?.item === "proposal") this.accept();
    else if (point && !this.#pressed) this.place(side, point);
  }

  #pressed = null; // the marker on which the latest press began

  #listenToBody(side) {
    const { canvas, controls } = this.bodies[side];
    const figure = canvas.parentElement;
    // This listener of the figure runs before those of the canvas, so that a drag of a marker does not turn the body.
    figure.addEventListener("pointerdown", (event) => {
      this.#pressed = null;
      if (!this.active || event.target !== canvas || event.button || this.#drag) return;
      const marker = this.markers[side].at(event, event.pointerType === "touch" ? REACH.touch : REACH.mouse);
      if (!marker) return;
      this.#pressed = marker;
      controls.enabled = false;
      if (marker.item === "proposal") return;
      const { id } = marker.item;
      this.#drag = { id, side, start: event, before: marker.item[side], moved: false };
      canvas.setPointerCapture(event.pointerId);
      this.select(id);
    }, { capture: true });
    canvas.addEventListener("pointermove", (event) => this.#onDrag(event));
    canvas.addEventListener("pointerup", () => {
      if (this.#drag) this.#endDrag(true);
      controls.enabled = true;
    });
    canvas.addEventListener("pointercancel", () => {
      if (this.#drag) this.#endDrag(false);
      controls.enabled = true;
    });
    figure.addEventListener("dragover", () => (figure.dataset.drop = "on"));
    for (const type of ["dragleave", "drop"]) figure.addEventListener(type, () => delete figure.dataset.drop);
    figure.addEventListener("drop", (event) => this.exchange.load(side, event.dataTransfer.files));
  }

  #onDrag(event) {
    const drag = this.#drag;
    if (!drag || drag.start.pointerId !== event.pointerId) return;
    drag.moved ||= Math.hypot(event.clientX - drag.start.clientX, event.clientY - drag.start.clientY) > DRAG_TOLERANCE;
    const point = drag.moved && this.bodies[drag.side].pointAt(event);
    if (!point) return;
    this.list.preview(drag.id, drag.side, point);
    this.update();
  }

  /** Ends a drag; the marker stays at its new place or returns to its old place. */
  #endDrag(stays) {
    const { id, side, before, moved } = this.#drag;
    this.#drag = null;
    this.bodies[side].controls.enabled = true;
    const point = this.list.entries.find((entry) => entry.id === id)[side];
    this.list.preview(id, side, before);
    if (stays && moved) this.list.move(id, side, point);
    this.update();
  }

  // ---- Keys

  /** Handles a key that is pressed on a body; returns whether it was handled. */
  onKey(body, event) {
    if (!this.active) return false;
    const side = body === this.bodies.x ? "x" : "y", crosshair = this.crosshairs[side];
    const arrow = event.shiftKey && arrows[event.key];
    if (arrow) crosshair.step(arrow, this.list.selection?.[side]);
    else if (event.key === "Enter" || event.key.toLowerCase() === "m") {
      const point = crosshair.point;
      if (!point) this.problem("The crosshair is beside the body; move it with Shift and the arrow keys.");
      else if (event.key === "Enter") this.place(side, point);
      else if (this.list.selection) {
        this.list.move(this.list.selected, side, point);
        this.update();
      }
    } else return event.key === "Escape"; // the page handles Escape
    event.preventDefault();
    return true;
  }

  #listenToPage() {
    document.addEventListener("keydown", (event) => {
      if (!this.active || document.querySelector("dialog[open]")) return;
      if (event.target.matches("input[type=text], input[type=number], select")) return;
      const key = event.key.toLowerCase(), command = event.ctrlKey || event.metaKey;
      if (command && (key === "y" || (key === "z" && event.shiftKey))) this.step(1);
      else if (command && key === "z") this.step(-1);
      else if (command || event.altKey) return;
      else if (key === "delete" || key === "backspace") this.remove();
      else if (key === "escape") this.cancel();
      else if (key === "a" && this.proposal) this.accept();
      else return;
      event.preventDefault();
    });
    // A file that is dropped beside the bodies must not replace the page.
    for (const type of ["dragover", "drop"]) document.addEventListener(type, (event) => event.preventDefault());
  }

  #listenToPanel() {
    const actions = {
      "landmark-mode": () => this.toggle(),
      "landmark-accept": () => this.accept(),
      "landmark-undo": () => this.step(-1),
      "landmark-redo": () => this.step(1),
      "landmark-delete": () => this.remove(),
      "landmark-suggest": () => this.suggest(),
      "landmark-copy": copyCommand,
      "landmark-flip": () => this.exchange.answer(true),
      "landmark-as-written": () => this.exchange.answer(false),
    };
    for (const [id, action] of Object.entries(actions)) byId(id).addEventListener("click", action);
    const list = byId("landmark-list"), field = byId("landmark-name");
    list.addEventListener("click", (event) => {
      const option = event.target.closest("[data-id]");
      if (option) this.select(Number(option.dataset.id));
    });
    list.addEventListener("dblclick", () => field.select());
    list.addEventListener("keydown", (event) => {
      const steps = { ArrowDown: 1, ArrowUp: -1, Home: -Infinity, End: Infinity };
      if (event.altKey || event.ctrlKey || event.metaKey) return;
      if (event.key in steps) {
        this.list.select(steps[event.key]);
        this.select(this.list.selected);
      } else if (event.key === "Enter" || event.key === "F2") field.select();
      else return;
      event.preventDefault();
    });
    field.addEventListener("change", () => {
      this.problem(this.list.rename(Number(field.dataset.id), field.value));
      fillName(this.list);
      this.update();
    });
    field.addEventListener("keydown", ({ key }) => {
      if (key === "Escape") fillName(this.list);
      if (key === "Escape" || key === "Enter") list.focus();
    });
    for (const button of document.querySelectorAll("[data-save]")) {
      button.addEventListener("click", () => this.exchange.save(button.dataset.save));
    }
    for (const side of sides) {
      byId(`landmark-file-${side}`).addEventListener("change", ({ target }) => {
        this.exchange.load(side, target.files).then(() => (target.value = ""));
      });
      byId(`landmark-format-${side}`).addEventListener("change", () => this.update());
    }
  }

  /** The position of a landmark in the coordinates of the mesh file. */
  position(side, entry) {
    return this.placements[side].toFile(this.bodies[side].shape.position(entry[side]));
  }

  /** What scripts and tests can read. */
  report() {
    const { list, proposal } = this;
    const screen = (side, point) => this.bodies[side].projectPoint(this.bodies[side].shape.position(point));
    const describe = (entry) => ({
      ...entry,
      color: this.color(entry),
      positions: { x: entry.x && this.position("x", entry), y: entry.y && this.position("y", entry) },
      screen: { x: entry.x && screen("x", entry.x), y: entry.y && screen("y", entry.y) },
    });
    return {
      active: this.active,
      entries: list.entries.map(describe),
      selected: list.selection?.name ?? null,
      proposal: proposal && { ...proposal, screen: screen(proposal.side, proposal.point) },
      suggestion: this.#suggestion,
      crosshairs: { x: this.crosshairs.x.place, y: this.crosshairs.y.place },
    };
  }
}
