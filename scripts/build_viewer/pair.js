// The interactive page: two bodies in 3D, the match of the vertex under the pointer, wavelets around both, and the
// functional map. Other modules add landmarks and the registered source.

import { Vector3 } from "three";
import { Body, decode, turns } from "./body.js";
import { Cameras } from "./cameras.js";
import { startLandmarks } from "./landmarks.js";
import { watchPointer } from "./input.js";
import { startRegistered } from "./registered.js";

const NAMED_VERTICES = 12; // the most source vertices that are listed for one target vertex
const WITHIN_SCALE = 0.98; // the share of values inside the colour scale of a function; the rest is clipped
const FIRST_ENTRY = [1, 1]; // the entry that the mode "eigenfunctions" opens with; eigenfunction 0 is constant

const byId = (id) => document.getElementById(id);
const data = JSON.parse(byId("data").textContent);

const maps = data.maps.map(({ name, map, errors, functional }) => ({
  name,
  pointwise: decode(map, Uint32Array),
  errors: Object.fromEntries(Object.entries(errors).map(([of, values]) => [of, decode(values, Float32Array)])),
  functional: functional && { ...functional, values: decode(functional.values, Float32Array) },
}));
const scales = Object.fromEntries(
  Object.entries(data.scales).map(([name, colors]) => [name, decode(colors, Uint8Array)]),
);

// For each shape, k eigenvectors of n numbers, one eigenvector after the other, and the responses of the filters at
// the k eigenvalues, one filter after the other. Null if the page has no eigenvectors.
const bases = data.x.eigenvectors && { x: readBasis(data.x), y: readBasis(data.y) };
function readBasis({ eigenvectors, responses }) {
  const units = decode(eigenvectors.units, Float32Array);
  const codes = decode(eigenvectors.codes, Int8Array);
  const [k, n] = [units.length, codes.length / units.length];
  const values = Float32Array.from(codes, (code, at) => units[Math.floor(at / n)] * code * Math.abs(code));
  return { k, n, values, responses: decode(responses, Float32Array) };
}
const filters = bases ? bases.x.responses.length / bases.x.k : 0;

const help = byId("help");
byId("help-open").addEventListener("click", () => help.showModal());
// A click on the backdrop has the dialog itself as target.
help.addEventListener("click", (event) => event.target === help && help.close());

let bodies;
try {
  const body = (side) => new Body(byId(`canvas-${side}`), decode(data[side].vertices, Float32Array), decode(data[side].faces, Uint32Array));
  bodies = { x: body("x"), y: body("y") };
} catch (error) {
  byId("readout").textContent = "This browser cannot show the bodies because it does not support WebGL. Please try another browser.";
  throw error;
}
const everyBody = Object.values(bodies);

// Draws after a change, at most once per frame.
let frame = 0;
function draw() {
  frame ||= requestAnimationFrame(() => {
    frame = 0;
    for (const body of everyBody) body.render();
  });
}

// ---- State

const sides = ["x", "y"];
const state = {
  map: 0,
  mode: "transfer", // what the bodies show while no entry of the functional map is chosen
  filter: 0,
  picked: null, // { side, vertex }, under the pointer or kept by a click
  pinned: false,
  entry: null, // [row, column] of the functional map, kept by a click
  hoveredEntry: null, // [row, column] under the pointer
};
let lastEntry = FIRST_ENTRY;
let functions = { x: null, y: null }; // the functions whose values the bodies show
let preimages = readPreimages(maps[0]);

/** Lists the source vertices that are mapped to target vertex j: `sources` from starts[j] to starts[j + 1]. */
function readPreimages({ pointwise }) {
  const starts = new Uint32Array(bodies.y.positions.length / 3 + 1);
  for (const j of pointwise) starts[j + 1]++;
  for (let j = 1; j < starts.length; j++) starts[j] += starts[j - 1];
  const sources = new Uint32Array(pointwise.length);
  const next = starts.slice();
  pointwise.forEach((j, i) => (sources[next[j]++] = i));
  return { starts, sources };
}

/** The picked vertex and the vertices of the other shape that are matched with it. */
function matched() {
  if (!state.picked) return { x: [], y: [] };
  const { side, vertex } = state.picked;
  if (side === "x") return { x: [vertex], y: [maps[state.map].pointwise[vertex]] };
  const { starts, sources } = preimages;
  return { x: Array.from(sources.subarray(starts[vertex], starts[vertex + 1])), y: [vertex] };
}

// ---- Functions on the bodies

function eigenfunction(side, index) {
  const { n, values } = bases[side];
  return values.slice(index * n, (index + 1) * n);
}

/** The wavelet around a vertex, sum_i g(lambda_i) phi_i(vertex) phi_i, for the chosen filter g. */
function wavelet(side, vertex) {
  const { k, n, values, responses } = bases[side];
  const result = new Float32Array(n);
  for (let i = 0; i < k; i++) {
    const coefficient = responses[state.filter * k + i] * values[i * n + vertex];
    if (coefficient) for (let v = 0, at = i * n; v < n; v++, at++) result[v] += coefficient * values[at];
  }
  return result;
}

/** The cosine of the angle between a function on the source and a function on the target, carried to the source. */
function similarity(x, y) {
  let both = 0, squareX = 0, squareY = 0;
  bodies.x.areas.forEach((area, i) => {
    const carried = y[maps[state.map].pointwise[i]];
    both += area * x[i] * carried;
    squareX += area * x[i] * x[i];
    squareY += area * carried * carried;
  });
  return both / Math.sqrt(squareX * squareY || 1);
}

/** The chosen entry of the functional map and its eigenfunctions x of the source and y of the target, or null. */
function shownEntry() {
  const entry = state.hoveredEntry ?? state.entry;
  const { functional } = maps[state.map];
  if (!entry || !functional) return null;
  const [row, column] = entry;
  // The entry may come from another map with a larger matrix.
  if (column >= functional.columns || row * functional.columns >= functional.values.length) return null;
  const [x, y] = functional.pushforward ? [column, row] : [row, column];
  const known = bases && x < bases.x.k && y < bases.y.k;
  return { row, column, x, y, known, value: functional.values[row * functional.columns + column] };
}

// ---- Colours

const colorsY = decode(data.colors, Uint8Array);
/** For each vertex of both bodies, 1 if it has no counterpart; null if all vertices have one. */
const alone = data.alone && { x: decode(data.alone.x, Uint8Array), y: decode(data.alone.y, Uint8Array) };

function colored(values, scale, index) {
  const colors = new Uint8Array(3 * values.length);
  values.forEach((value, i) => {
    const at = 3 * index(value);
    colors.set(Number.isNaN(value) ? data.plain : scale.subarray(at, at + 3), 3 * i);
  });
  return colors;
}

/** The name of the error that a mode shows; undefined for other modes. */
const errorName = (mode) => data.error_names[Number(mode.split("-")[1])];

const onErrorScale = (value) => Math.round(255 * Math.min(value / data.limit, 1)) || 0;
const onSignedScale = (limit) => (value) => 127 + Math.round(127 * Math.max(-1, Math.min(1, value / limit)));

/** What the bodies show: eigenfunctions while an entry of the functional map is chosen, else the chosen mode. */
const shownMode = () => (shownEntry()?.known ? "eigenfunctions" : state.mode);

/** Makes buttons, explanation and legends agree with what the bodies show. */
function announce(mode, scale) {
  for (const input of document.querySelectorAll("input[name=mode]")) input.checked = input.value === mode;
  for (const text of document.querySelectorAll("[data-for]")) text.classList.toggle("current", text.dataset.for === mode);
  document.body.dataset.shown = mode;
  document.body.dataset.scale = scale;
  document.body.dataset.mode = state.mode;
}

/** Returns colours in which the marked vertices are grey. */
function greyed(colors, marked) {
  const result = colors.slice();
  marked.forEach((mark, i) => mark && result.set(data.plain, 3 * i));
  return result;
}

/** Colours both bodies as the mode says. */
function paint() {
  const { pointwise, errors } = maps[state.map];
  const mode = shownMode();
  const colors = { x: null, y: null };
  let scale = "none";
  functions = { x: null, y: null };
  if (mode === "transfer") {
    colors.y = colorsY;
    colors.x = new Uint8Array(3 * pointwise.length);
    pointwise.forEach((j, i) => colors.x.set(colorsY.subarray(3 * j, 3 * j + 3), 3 * i));
    if (alone) for (const side of ["x", "y"]) colors[side] = greyed(colors[side], alone[side]);
  } else if (mode === "eigenfunctions") {
    const entry = shownEntry();
    functions = { x: eigenfunction("x", entry.x), y: eigenfunction("y", entry.y) };
  } else if (mode === "wavelets") {
    const { x, y } = matched();
    if (x.length) functions.x = wavelet("x", x[0]);
    if (y.length) functions.y = wavelet("y", y[0]);
  } else if (mode !== "plain") {
    const values = errors[errorName(mode)];
    colors.x = colored(values, scales.error, onErrorScale);
    byId("unknown").hidden = !values.some(Number.isNaN);
    scale = "error";
  }
  if (functions.x || functions.y) {
    paintFunctions(colors);
    scale = "signed";
  }
  for (const side of sides) {
    const plain = () => new Uint8Array(bodies[side].positions.length).map((_, i) => data.plain[i % 3]);
    bodies[side].paint(colors[side] ?? plain());
  }
  announce(mode, scale);
  draw();
}

/** Fills in the colours of the functions, on one scale for both bodies, and the ends of the scale. */
function paintFunctions(colors) {
  const sizes = Float32Array.from([...(functions.x ?? []), ...(functions.y ?? [])], Math.abs).sort();
  const limit = sizes[Math.round(WITHIN_SCALE * (sizes.length - 1))] || 1;
  for (const side of sides) {
    if (functions[side]) colors[side] = colored(functions[side], scales.signed, onSignedScale(limit));
  }
  const end = Number(limit.toPrecision(2));
  byId("signed-low").textContent = `≤ −${end}`;
  byId("signed-high").textContent = `≥ ${end}`;
}

// ---- Words and marks

const invitation = byId("readout").textContent;

function say(id, text) {
  if (byId(id).textContent !== text) byId(id).textContent = text;
}

function nameFilter() {
  const wavelets = filters - 1;
  const ends = { 1: " (widest)", [wavelets]: " (narrowest)" };
  if (!state.filter) return "scaling function";
  return `wavelet ${state.filter} of ${wavelets}${ends[state.filter] ?? ""}`;
}

function inWords(error) {
  if (Number.isNaN(error)) return "unknown";
  return error === Infinity ? "infinite (the match is on a separate component of the surface)" : error.toFixed(4);
}

/** Marks the picked vertex and its matches, and says in words what is shown. */
function tell() {
  const { x, y } = matched();
  let text = invitation;
  if (state.picked?.side === "x") {
    text = `Source vertex ${x[0]} → target vertex ${y[0]}`;
    for (const [name, values] of Object.entries(maps[state.map].errors)) {
      text += ` · ${name.toLowerCase()} ${inWords(values[x[0]])}`;
    }
  } else if (state.picked) {
    const named = x.slice(0, NAMED_VERTICES).join(", ") + (x.length > NAMED_VERTICES ? ", …" : "");
    const count = x.length === 1 ? "source vertex" : `${x.length} source vertices:`;
    text = `Target vertex ${y[0]} ← ${x.length ? `${count} ${named}` : "no source vertex"}`;
  }
  const entry = shownEntry();
  if (entry?.known && !state.picked) text = `Eigenfunction ${entry.x} of the source, ${entry.y} of the target`;
  if (shownMode() === "wavelets") {
    if (functions.x && functions.y) {
      text += ` · similarity of the wavelets ${similarity(functions.x, functions.y).toFixed(3)} (1 is the same)`;
    } else if (!state.picked) text = "Point at a body to see the wavelet around that point and the wavelet around its match.";
  }
  for (const side of sides) bodies[side].mark(matched()[side]);
  say("readout", text);
  draw();
}

/** Picks a vertex of one side, or none (null). A picked vertex that is pinned stays when the pointer moves on. */
function pick(side, vertex, pinned = false) {
  state.picked = vertex === null ? null : { side, vertex };
  state.pinned = pinned && vertex !== null;
  if (pinned) byId("vertex").value = state.picked && side === "x" ? vertex : "";
  if (shownMode() === "wavelets") paint();
  tell();
}
const pin = (side, vertex) => pick(side, vertex, true);

function chooseMode(mode) {
  if (mode === "eigenfunctions") {
    chooseEntry(lastEntry);
    if (!shownEntry()?.known) chooseEntry([0, 0]); // this map or this page lacks the last entry
  } else {
    state.mode = mode;
    chooseEntry(null);
  }
}

function chooseMap(index) {
  state.map = index;
  preimages = readPreimages(maps[index]);
  const { errors, functional } = maps[index];
  for (const input of document.querySelectorAll("input[name=mode]")) {
    const error = errorName(input.value);
    input.disabled = input.value === "eigenfunctions" ? !functional : error !== undefined && !Object.hasOwn(errors, error);
    // A mode that this map does not have cannot stay chosen.
    if (input.disabled && state.mode === input.value) state.mode = "transfer";
  }
  document.querySelectorAll("input[name=map]").forEach((input, i) => (input.checked = i === index));
  document.querySelectorAll("tbody tr").forEach((row, i) => row.setAttribute("aria-current", i === index));
  drawMatrix();
  paint();
  tell();
  tellEntry();
}

// ---- The functional map

const matrix = byId("matrix");
const darkness = matchMedia("(prefers-color-scheme: dark)");
const largestEntry = maps.reduce(
  (largest, { functional }) => (functional?.values ?? []).reduce((a, b) => Math.max(a, Math.abs(b)), largest),
  0,
);

function drawMatrix() {
  const { functional } = maps[state.map];
  byId("functional").hidden = !functional;
  if (!functional) return;
  matrix.width = functional.columns;
  matrix.height = functional.values.length / functional.columns;
  const scale = darkness.matches ? scales.signed_dark : scales.signed;
  const colors = colored(functional.values, scale, onSignedScale(largestEntry || 1));
  const picture = new ImageData(matrix.width, matrix.height);
  for (let i = 0; i < functional.values.length; i++) {
    picture.data.set(colors.subarray(3 * i, 3 * i + 3), 4 * i);
    picture.data[4 * i + 3] = 255;
  }
  matrix.getContext("2d").putImageData(picture, 0, 0);
  const end = largestEntry.toPrecision(2);
  byId("matrix-low").textContent = `−${end}`;
  byId("matrix-high").textContent = end;
  const [row, column] = functional.pushforward ? ["target", "source"] : ["source", "target"];
  byId("matrix-axes").textContent =
    `The map as a table: an entry says how strongly a vibration pattern of the ${row} (row) and a pattern of the ` +
    `${column} (column) belong together. A good map between two poses of one body has its large entries near the diagonal.`;
}

function entryAt(event) {
  const box = matrix.getBoundingClientRect();
  const at = (place, size, count) => Math.max(0, Math.min(count - 1, Math.floor((place / size) * count)));
  return [
    at(event.clientY - box.top, box.height, matrix.height),
    at(event.clientX - box.left, box.width, matrix.width),
  ];
}

function tellEntry() {
  const entry = shownEntry();
  const ring = byId("ring");
  ring.hidden = !entry;
  if (entry) {
    ring.style.left = `${(100 * (entry.column + 0.5)) / matrix.width}%`;
    ring.style.top = `${(100 * (entry.row + 0.5)) / matrix.height}%`;
    const value = entry.value.toFixed(3).replace("-", "−");
    const where = entry.known ? "" : " (which this page does not hold)";
    say("entry", `Entry (${entry.row}, ${entry.column}) is ${value}: eigenfunction ${entry.x} of the source, ${entry.y} of the target${where}.`);
  } else say("entry", "Point at an entry to see its two eigenfunctions.");
}

function chooseEntry(entry, hovered = null) {
  Object.assign(state, { entry, hoveredEntry: hovered });
  if (entry) lastEntry = entry;
  paint();
  tell();
  tellEntry();
}

// ---- Cameras

const direction = new Vector3().setFromSphericalCoords(1, Math.PI / 2 - data.elevation, data.azimuth);
const cameras = new Cameras(everyBody, { direction, linked: byId("linked"), onMove: draw });

/** Turns the bodies so that these surface points, { x, y }, face the viewer. */
function turnTowards(points) {
  for (const [side, point] of Object.entries(points)) {
    if (!point || (side === "y" && byId("linked").checked)) continue;
    const body = bodies[side];
    const distance = body.camera.position.distanceTo(body.controls.target);
    body.lookFrom(new Vector3(...body.shape.viewOf(point)).setLength(distance));
  }
  cameras.untouched = false;
}

function onKey(body, event) {
  if (event.altKey || event.ctrlKey || event.metaKey) return;
  if (landmarks.onKey(body, event)) return;
  if (event.key === "Escape") {
    pin("x", null);
    chooseEntry(null);
  } else if (!cameras.onKey(body, event.key)) return;
  event.preventDefault();
}

// ---- Mouse, touch and keys

for (const [side, body] of Object.entries(bodies)) {
  body.canvas.addEventListener("keydown", (event) => onKey(body, event));
  watchPointer(body, {
    hovers: () => !state.pinned && !landmarks.active,
    hover: (event) => pick(side, event && body.vertexAt(event)),
    click: (event) => {
      if (landmarks.active) landmarks.onClick(side, body.pointAt(event));
      else pin(side, body.vertexAt(event));
    },
  });
}

for (const input of document.querySelectorAll("input[name=mode]")) {
  input.addEventListener("click", () => chooseMode(input.value));
}
for (const input of document.querySelectorAll("input[name=map]")) {
  input.addEventListener("click", () => chooseMap(Number(input.value)));
}
byId("filter").addEventListener("input", chooseFilter);
function chooseFilter() {
  state.filter = byId("filter").valueAsNumber;
  say("filter-name", nameFilter());
  byId("filter").setAttribute("aria-valuetext", nameFilter());
  paint();
  tell();
}

matrix.addEventListener("pointermove", (event) => {
  const entry = entryAt(event);
  if (event.pointerType !== "touch" && String(entry) !== String(state.hoveredEntry)) chooseEntry(state.entry, entry);
});
matrix.addEventListener("pointerleave", () => state.hoveredEntry && chooseEntry(state.entry));
matrix.addEventListener("click", (event) => {
  const entry = entryAt(event);
  chooseEntry(String(entry) === String(state.entry) ? null : entry);
});
matrix.addEventListener("keydown", (event) => {
  if (event.altKey || event.ctrlKey || event.metaKey) return;
  const move = turns[event.key];
  if (move) {
    const step = event.shiftKey ? 10 : 1;
    const [row, column] = state.entry ?? [0, 0];
    const within = (index, size) => Math.max(0, Math.min(size - 1, index));
    // The first key only chooses the first entry.
    const [across, down] = state.entry ? move : [0, 0];
    chooseEntry([within(row + step * down, matrix.height), within(column + step * across, matrix.width)]);
  } else if (event.key === "Escape") chooseEntry(null);
  else return;
  event.preventDefault();
});
darkness.addEventListener("change", drawMatrix);

byId("reset").addEventListener("click", () => cameras.reset());
byId("vertex").addEventListener("change", ({ target }) => {
  if (target.value === "") pin("x", null);
  else if (target.reportValidity()) pin("x", target.valueAsNumber);
});

// Narrow screens show wide bodies one above the other, and tall bodies side by side.
document.body.dataset.shape = data.wide ? "wide" : "tall";

const observer = new ResizeObserver(() => {
  for (const body of everyBody) body.resize();
  if (cameras.untouched) cameras.reset();
  // Draw at once, because resizing has emptied the canvas.
  for (const body of everyBody) body.render();
});
for (const body of everyBody) observer.observe(body.canvas);

const landmarks = startLandmarks({ bodies, data, draw, turnTowards, unpin: () => pin("x", null), currentMap: () => maps[state.map], maps });
startRegistered({ bodies, data, draw });

byId("filter").disabled = filters < 2;
chooseFilter();
chooseMap(0);
if (data.landmarks) landmarks.exchange.show(data.landmarks);

// For scripts and tests: pick a source vertex, and read the state, the colours, the landmarks and the position of a
// vertex in the window.
window.jaxsmw = {
  pick: (vertex) => pin("x", vertex),
  project: (side, vertex) => bodies[side].project(vertex),
  colors: (side) => Array.from(bodies[side].colors),
  get landmarks() {
    return landmarks.report();
  },
  get functions() {
    return { x: functions.x && Array.from(functions.x), y: functions.y && Array.from(functions.y) };
  },
  get state() {
    const { map, filter, pinned, entry } = state;
    const mode = shownMode();
    return { source: bodies.x.marked, target: bodies.y.marked, map: maps[map].name, mode, filter, pinned, entry };
  },
};
