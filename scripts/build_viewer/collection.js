// The page of a collection: all shapes as small pictures, two shapes to compare, the mean shape with its modes, the
// matched pairs and the scores.

import { Vector3 } from "three";
import { Body, decode } from "./body.js";
import { Cameras } from "./cameras.js";
import { startDeformation } from "./collection_modes.js";
import { startPlots } from "./collection_plots.js";
import { drawThumbnails, makeGallery } from "./collection_gallery.js";
import { watchPointer } from "./input.js";

const WITHIN_SCALE = 0.98; // the share of distances inside the colour scale; the rest is clipped
const WIDE = 0.9; // narrow screens show bodies one above the other if they are wider than this multiple of their height

const byId = (id) => document.getElementById(id);
const data = JSON.parse(byId("data").textContent);
const faces = decode(data.faces, Uint32Array);
const colors = decode(data.colors, Uint8Array);
const scale = decode(data.scales.error, Uint8Array);
const plain = Uint8Array.from(colors, (_, i) => data.plain[i % 3]);
const numbers = data.vertices && decode(data.vertices, Uint32Array);

function readPositions({ low, step, codes }) {
  return Float32Array.from(decode(codes, Uint16Array), (code, i) => low[i % 3] + step[i % 3] * code);
}

/** Moves the middle of the bounding box to the origin, around which the camera turns. */
function centered(positions, { low, step }) {
  const middle = low.map((least, axis) => least + (65535 * step[axis]) / 2);
  return positions.map((value, i) => value - middle[i % 3]);
}

const aligned = new Map();
/** The positions of a shape after the alignment. */
function positionsOf(index) {
  if (!aligned.has(index)) aligned.set(index, readPositions(data.shapes[index]));
  return aligned.get(index);
}
const centeredShape = (index) => centered(positionsOf(index), data.shapes[index]);

const direction = new Vector3().setFromSphericalCoords(1, Math.PI / 2 - data.elevation, data.azimuth);

const state = {
  a: data.template,
  b: data.shapes.length > 1 ? Number(data.template === 0) : data.template,
  side: "b", // the body that shows the shape of the next click
  view: data.shapes.length > 1 ? "two" : "one",
  mode: "match",
  vertex: null, // under the pointer or kept by a click
  pinned: false,
};
const sides = ["a", "b"];

let bodies = null;
try {
  const body = (side) => new Body(byId(`canvas-${side}`), centeredShape(state[side]).slice(), faces);
  bodies = { a: body("a"), b: body("b") };
} catch {
  document.body.dataset.webgl = "off";
  byId("no-webgl").hidden = false;
}
const everyBody = bodies ? Object.values(bodies) : [];
const cameras = new Cameras(everyBody, { direction, linked: byId("linked"), onMove: () => draw() });

const canvases = makeGallery(data, (index) => open(index));
const plots = startPlots({ data, open: (index) => open(index), compare });
const deformation =
  bodies && data.model?.modes.length
    ? startDeformation({ data, colors, faces, direction, readPositions, centered, onChange: plots.moveCursor })
    : null;

// ---- The two bodies

// Draws after a change, at most once per frame.
let frame = 0;
function draw() {
  frame ||= requestAnimationFrame(() => {
    frame = 0;
    render();
  });
}

function render() {
  for (const body of everyBody) if (body.canvas.clientWidth) body.render();
}

/** The distances between the same vertices of both shapes, in units of the square root of the template's area. */
function distances() {
  const [a, b] = [positionsOf(state.a), positionsOf(state.b)];
  return Float32Array.from({ length: a.length / 3 }, (_, v) => Math.hypot(a[3 * v] - b[3 * v], a[3 * v + 1] - b[3 * v + 1], a[3 * v + 2] - b[3 * v + 2]));
}

function differenceColors() {
  const values = distances();
  const limit = values.slice().sort()[Math.round(WITHIN_SCALE * (values.length - 1))] || 1;
  byId("scale-end").textContent = `${Number(limit.toPrecision(2))} and above (fraction of √area)`;
  const result = new Uint8Array(colors.length);
  values.forEach((value, v) => {
    const at = 3 * Math.round(255 * Math.min(value / limit, 1));
    result.set(scale.subarray(at, at + 3), 3 * v);
  });
  return result;
}

function paint() {
  // One shape alone has no difference.
  const mode = state.mode === "difference" && state.view === "one" ? "match" : state.mode;
  const shown = { match: () => colors, plain: () => plain, difference: differenceColors }[mode]();
  for (const body of everyBody) body.paint(shown);
  document.body.dataset.mode = state.mode;
  draw();
}

const invitation = byId("readout").textContent;
/** Marks the picked vertex on both shapes, and says in words how far it is from one to the other. */
function tell() {
  for (const body of everyBody) body.mark(state.vertex === null ? [] : [state.vertex]);
  let text = state.view === "two" ? invitation : "Point at the shape to see the number of a vertex.";
  if (state.vertex !== null) {
    text = `Vertex ${numbers ? numbers[state.vertex] : state.vertex} of the template`;
    if (state.view === "two") text += ` · ${distances()[state.vertex].toFixed(3)} √area from A to B, after alignment`;
  }
  if (byId("readout").textContent !== text) byId("readout").textContent = text;
  draw();
}

function pick(vertex, pinned = false) {
  Object.assign(state, { vertex, pinned: pinned && vertex !== null });
  tell();
}

/** Shows a shape in the chosen body. */
function open(index, side = state.view === "one" ? "b" : state.side) {
  state[side] = index;
  bodies?.[side].move(centeredShape(index));
  if (cameras.untouched) cameras.reset();
  update();
  const box = byId("stage").getBoundingClientRect();
  if (box.bottom < 120 || box.top > innerHeight - 120) byId("stage").scrollIntoView({ block: "nearest" });
}

/** Shows both shapes of a matched pair. */
function compare(edge) {
  const { source, target } = data.edges[edge];
  setView("two");
  open(source, "a");
  open(target, "b");
}

/** Makes controls, pictures and plots agree with the shapes that are shown. */
function update() {
  document.body.dataset.view = state.view;
  for (const side of sides) {
    byId(`choose-${side}`).value = state[side];
    byId(`canvas-${side}`).setAttribute("aria-label", `Shape ${side.toUpperCase()}: ${data.names[state[side]]}`);
  }
  const shown = state.view === "one" ? ["b"] : sides;
  const marks = data.names.map((_, index) => shown.filter((side) => state[side] === index));
  canvases.mark(marks);
  plots.mark(marks.map((found) => found.length > 0));
  paint();
  tell();
}

function setView(view) {
  state.view = view;
  for (const input of document.querySelectorAll("input[name=view]")) input.checked = input.value === view;
  update();
}

// ---- Mouse, touch and keys

for (const body of everyBody) {
  body.canvas.addEventListener("keydown", (event) => {
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    if (event.key === "Escape") pick(null);
    else if (!cameras.onKey(body, event.key)) return;
    event.preventDefault();
  });
  watchPointer(body, {
    hovers: () => !state.pinned,
    hover: (event) => pick(event && body.vertexAt(event)),
    click: (event) => pick(body.vertexAt(event), true),
  });
}

for (const side of sides) {
  const select = byId(`choose-${side}`);
  select.append(...data.names.map((name, index) => new Option(name, index)));
  select.addEventListener("change", () => open(Number(select.value), side));
}
const onChoice = (name, choose) => {
  for (const input of document.querySelectorAll(`input[name=${name}]`)) input.addEventListener("click", () => choose(input.value));
};
onChoice("view", setView);
onChoice("side", (side) => (state.side = side));
onChoice("mode", (mode) => {
  state.mode = mode;
  paint();
});
byId("reset").addEventListener("click", () => cameras.reset());
for (const button of document.querySelectorAll(".pair")) {
  button.addEventListener("click", () => compare(Number(button.dataset.edge)));
}

const extent = (axis) => 65535 * Math.max(...data.shapes.map(({ step }) => step[axis]));
document.body.dataset.shape = Math.max(extent(0), extent(2)) > WIDE * extent(1) ? "wide" : "tall";

if (bodies) {
  const observer = new ResizeObserver(() => {
    for (const body of everyBody) if (body.canvas.clientWidth) body.resize();
    if (cameras.untouched) cameras.reset();
    render(); // at once, because resizing has emptied the canvas
  });
  for (const body of everyBody) observer.observe(body.canvas);
}
if (data.shapes.length < 2) for (const choice of document.querySelectorAll("#look > :first-child")) choice.hidden = true;
setView(state.view);

let pictures = 0;
if (bodies) {
  drawThumbnails({ canvases: canvases.list, shape: centeredShape, colors, faces, direction }, (index, canvas) => {
    pictures++;
    plots.showPicture(index, canvas);
  });
}

// For scripts and tests: open shapes, and read the state and the position of a vertex in the window.
window.jaxsmw = {
  open: (index, side) => open(index, side),
  project: (side, vertex) => bodies[side].project(vertex),
  colors: (side) => Array.from(bodies[side].colors),
  positions: (index) => Array.from(positionsOf(index)),
  get deformed() {
    return deformation ? deformation.positions() : null;
  },
  get state() {
    return { ...state, pictures, marked: bodies && sides.map((side) => bodies[side].marked), scores: deformation ? deformation.scores() : null };
  },
};
