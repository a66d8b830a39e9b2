// The interactive page: two bodies to turn, the map between their vertices under the pointer, wavelets around
// it, and the functional map.
// Bundled with three.js into jaxsmw/report/assets/viewer.js by build.mjs; the page around it is page.html.

import {
  AmbientLight,
  BackSide,
  BufferAttribute,
  BufferGeometry,
  Color,
  DirectionalLight,
  DoubleSide,
  HemisphereLight,
  InstancedMesh,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  MeshStandardMaterial,
  PerspectiveCamera,
  Raycaster,
  Scene,
  SphereGeometry,
  Spherical,
  SRGBColorSpace,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const FIELD_OF_VIEW = 25;
// The caption lies over the top of the canvas; so much of the upper half is left for the body.
const BELOW_CAPTION = 0.85;
const KEY_TURN = Math.PI / 18;
const KEY_ZOOM = 1.15;
const CLICK_TOLERANCE = 5; // pixels that the pointer may move between press and release
const NAMED_VERTICES = 12; // of those mapped to one target vertex
const WITHIN_SCALE = 0.98; // of the values of functions; the rest takes the last colours

const byId = (id) => document.getElementById(id);
const data = JSON.parse(byId("data").textContent);
const decode = (text, Type) => new Type(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);

// Screen colours in bytes to the light intensities that three.js interpolates and shades.
const LINEAR = Float32Array.from({ length: 256 }, (_, byte) => new Color().setRGB(byte / 255, 0, 0, SRGBColorSpace).r);

const maps = data.maps.map(({ name, map, errors, functional }) => ({
  name,
  pointwise: decode(map, Uint32Array),
  errors: Object.fromEntries(Object.entries(errors).map(([of, values]) => [of, decode(values, Float32Array)])),
  functional: functional && { ...functional, values: decode(functional.values, Float32Array) },
}));
const scales = Object.fromEntries(
  Object.entries(data.scales).map(([name, colors]) => [name, decode(colors, Uint8Array)]),
);

// Of each shape: k eigenvectors of n numbers one after the other, and responses of one filter after the other.
// Null where the page has none.
const bases = data.x.eigenvectors && { x: readBasis(data.x), y: readBasis(data.y) };
function readBasis({ eigenvectors, responses }) {
  const units = decode(eigenvectors.units, Float32Array);
  const codes = decode(eigenvectors.codes, Int8Array);
  const [k, n] = [units.length, codes.length / units.length];
  const values = Float32Array.from(codes, (code, at) => units[Math.floor(at / n)] * code * Math.abs(code));
  return { k, n, values, responses: decode(responses, Float32Array) };
}
const filters = bases ? bases.x.responses.length / bases.x.k : 0;

// White with a black rim, to be seen on every colour; faint where the body is in front.
const CORE = new SphereGeometry(1, 20, 14);
const RIM = new SphereGeometry(1.5, 20, 14);
const MARK_LOOKS = [
  [RIM, new MeshBasicMaterial({ color: 0x000000, side: BackSide })],
  [CORE, new MeshBasicMaterial({ color: 0xffffff })],
  [CORE, new MeshBasicMaterial({ color: 0xffffff, transparent: true, opacity: 0.4, depthTest: false })],
];

/** One body in its canvas: the surface, its light, camera and marks. */
class Body {
  #areas = null;

  constructor(canvas, { vertices, faces }) {
    this.canvas = canvas;
    this.renderer = new WebGLRenderer({ canvas, alpha: true, antialias: true });
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.05, 100);
    this.scene.add(this.camera);
    this.#light();

    this.positions = decode(vertices, Float32Array);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(this.positions, 3));
    geometry.setAttribute("color", new BufferAttribute(new Float32Array(this.positions.length), 3));
    geometry.setIndex(new BufferAttribute(decode(faces, Uint32Array), 1));
    geometry.computeVertexNormals();
    geometry.computeBoundingSphere();
    this.surface = new Mesh(
      geometry,
      new MeshStandardMaterial({ vertexColors: true, side: DoubleSide, roughness: 0.62 }),
    );
    this.scene.add(this.surface);

    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.marked = [];
    this.marks = [];
  }

  /** Lamps that move with the viewer: what one turns towards oneself is always well lit. */
  #light() {
    const lamp = (strength, ...position) => {
      const light = new DirectionalLight(0xffffff, strength);
      light.position.set(...position);
      this.camera.add(light, light.target);
      light.target.position.set(0, 0, -1);
    };
    lamp(2.1, -0.7, 0.9, 0);
    lamp(0.55, 1.3, 0.2, -0.3);
    this.scene.add(new HemisphereLight(0xffffff, 0x8a8f99, 0.75), new AmbientLight(0xffffff, 0.35));
  }

  vertex(index) {
    return new Vector3().fromArray(this.positions, 3 * index);
  }

  /** Give every vertex its colour, three bytes each. */
  paint(colors) {
    this.colors = colors;
    const attribute = this.surface.geometry.attributes.color;
    for (let i = 0; i < colors.length; i++) attribute.array[i] = LINEAR[colors[i]];
    attribute.needsUpdate = true;
  }

  /** Barycentric areas of the vertices. */
  get areas() {
    if (this.#areas) return this.#areas;
    this.#areas = new Float32Array(this.positions.length / 3);
    const corners = this.surface.geometry.index.array;
    for (let f = 0; f < corners.length; f += 3) {
      const [a, b, c] = [0, 1, 2].map((corner) => this.vertex(corners[f + corner]));
      const third = b.sub(a).cross(c.sub(a)).length() / 6;
      for (let corner = 0; corner < 3; corner++) this.#areas[corners[f + corner]] += third;
    }
    return this.#areas;
  }

  /** Mark vertices, in place of those marked before. */
  mark(indices) {
    this.marked = indices;
    for (const mark of this.marks) {
      this.scene.remove(mark);
      mark.dispose();
    }
    this.marks = MARK_LOOKS.map((look) => new InstancedMesh(...look, indices.length));
    // Where the marks are changes later than three.js looks.
    for (const mark of this.marks) mark.frustumCulled = false;
    if (indices.length) this.scene.add(...this.marks);
  }

  /** Marks keep their size on the screen however near the viewer is. */
  #placeMarks() {
    const pixel = (2 * Math.tan((FIELD_OF_VIEW * Math.PI) / 360)) / this.canvas.clientHeight;
    const pixels = this.marked.length > 1 ? 4.5 : 6;
    this.marked.forEach((index, i) => {
      const center = this.vertex(index);
      const towards = this.camera.position.clone().sub(center);
      const radius = pixels * pixel * towards.length();
      // Clear of the surface, along the line of sight, so that it does not cut into the mark.
      center.addScaledVector(towards.normalize(), 2 * radius);
      const matrix = new Matrix4().makeScale(radius, radius, radius).setPosition(center);
      for (const mark of this.marks) mark.setMatrixAt(i, matrix);
    });
    for (const mark of this.marks) mark.instanceMatrix.needsUpdate = true;
  }

  /** The distance from which the whole body is seen from the direction of `offset`. */
  distanceToFit(offset) {
    const camera = this.camera.clone(false);
    camera.position.copy(offset);
    camera.lookAt(0, 0, 0);
    camera.updateMatrixWorld();
    const axes = [0, 1, 2].map((column) => new Vector3().setFromMatrixColumn(camera.matrixWorld, column));
    const half = Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
    const point = new Vector3();
    let distance = 0;
    for (let i = 0; i < this.positions.length; i += 3) {
      const [x, y, z] = axes.map((axis) => point.fromArray(this.positions, i).dot(axis));
      const height = Math.max(-y, y / BELOW_CAPTION);
      distance = Math.max(distance, z + height / half, z + Math.abs(x) / (half * this.camera.aspect));
    }
    return 1.08 * distance;
  }

  /** The vertex under the pointer, or null. */
  vertexAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const x = (2 * (event.clientX - box.left)) / box.width - 1;
    const y = 1 - (2 * (event.clientY - box.top)) / box.height;
    const raycaster = new Raycaster();
    raycaster.setFromCamera(new Vector2(x, y), this.camera);
    const [hit] = raycaster.intersectObject(this.surface);
    if (!hit) return null;
    const corners = [hit.face.a, hit.face.b, hit.face.c];
    const distances = corners.map((corner) => this.vertex(corner).distanceTo(hit.point));
    return corners[distances.indexOf(Math.min(...distances))];
  }

  /** Where a vertex is in the window, in CSS pixels. */
  project(index) {
    const box = this.canvas.getBoundingClientRect();
    this.camera.updateMatrixWorld();
    const { x, y } = this.vertex(index).project(this.camera);
    return { x: box.left + ((x + 1) / 2) * box.width, y: box.top + ((1 - y) / 2) * box.height };
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
  }

  render() {
    this.#placeMarks();
    this.renderer.render(this.scene, this.camera);
  }
}

let bodies;
try {
  bodies = { x: new Body(byId("canvas-x"), data.x), y: new Body(byId("canvas-y"), data.y) };
} catch (error) {
  byId("readout").textContent = "The bodies cannot be shown: this browser offers no WebGL.";
  throw error;
}
const everyBody = Object.values(bodies);

// Draw when something changed, at most once a frame.
let frame = 0;
function draw() {
  frame ||= requestAnimationFrame(() => {
    frame = 0;
    for (const body of everyBody) body.render();
  });
}

// ---- What is shown

const sides = ["x", "y"];
const state = {
  map: 0,
  coloring: "transfer",
  filter: 0,
  picked: null, // { side, vertex }, under the pointer or kept
  pinned: false,
  entry: null, // [row, column] of the functional map, kept
  hoveredEntry: null,
};
let functions = { x: null, y: null }; // those in colours on the bodies, if any
let preimages = readPreimages(maps[0]);

/** The source vertices of each target vertex j: `sources` from starts[j] to starts[j + 1]. */
function readPreimages({ pointwise }) {
  const starts = new Uint32Array(bodies.y.positions.length / 3 + 1);
  for (const j of pointwise) starts[j + 1]++;
  for (let j = 1; j < starts.length; j++) starts[j] += starts[j - 1];
  const sources = new Uint32Array(pointwise.length);
  const next = starts.slice();
  pointwise.forEach((j, i) => (sources[next[j]++] = i));
  return { starts, sources };
}

/** The vertices of both shapes that belong to what is picked. */
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

/** sum_i g(lambda_i) phi_i(vertex) phi_i, of the chosen filter. */
function wavelet(side, vertex) {
  const { k, n, values, responses } = bases[side];
  const result = new Float32Array(n);
  for (let i = 0; i < k; i++) {
    const coefficient = responses[state.filter * k + i] * values[i * n + vertex];
    if (coefficient) for (let v = 0, at = i * n; v < n; v++, at++) result[v] += coefficient * values[at];
  }
  return result;
}

/** The cosine of the angle between a function on the source and one on the target, carried over by the map. */
function alikeness(x, y) {
  let both = 0, squareX = 0, squareY = 0;
  bodies.x.areas.forEach((area, i) => {
    const carried = y[maps[state.map].pointwise[i]];
    both += area * x[i] * carried;
    squareX += area * x[i] * x[i];
    squareY += area * carried * carried;
  });
  return both / Math.sqrt(squareX * squareY || 1);
}

/** The entry of the functional map that is shown, as eigenfunctions of the source and of the target. */
function shownEntry() {
  const entry = state.hoveredEntry ?? state.entry;
  const { functional } = maps[state.map];
  if (!entry || !functional) return null;
  const [row, column] = entry;
  // Another map's may be larger.
  if (column >= functional.columns || row * functional.columns >= functional.values.length) return null;
  const [x, y] = functional.pushforward ? [column, row] : [row, column];
  const known = bases && x < bases.x.k && y < bases.y.k;
  return { row, column, x, y, known, value: functional.values[row * functional.columns + column] };
}

// ---- Colours

const colorsY = decode(data.colors, Uint8Array);

function colored(values, scale, index) {
  const colors = new Uint8Array(3 * values.length);
  values.forEach((value, i) => {
    const at = 3 * index(value);
    colors.set(Number.isNaN(value) ? data.plain : scale.subarray(at, at + 3), 3 * i);
  });
  return colors;
}

const onErrorScale = (value) => Math.round(255 * Math.min(value / data.limit, 1)) || 0;
const onSignedScale = (limit) => (value) => 127 + Math.round(127 * Math.max(-1, Math.min(1, value / limit)));

/** Colour both bodies by what is chosen. */
function paint() {
  const { pointwise, errors } = maps[state.map];
  const entry = shownEntry();
  let shown = state.coloring.split("-")[0];
  functions = { x: null, y: null };
  if (entry?.known) {
    functions = { x: eigenfunction("x", entry.x), y: eigenfunction("y", entry.y) };
    shown = "signed";
  } else if (shown === "wavelets") {
    const { x, y } = matched();
    if (x.length) functions.x = wavelet("x", x[0]);
    if (y.length) functions.y = wavelet("y", y[0]);
    shown = state.picked ? "signed" : "plain";
  }

  const colors = { x: null, y: null };
  if (shown === "transfer") {
    colors.y = colorsY;
    colors.x = new Uint8Array(3 * pointwise.length);
    pointwise.forEach((j, i) => colors.x.set(colorsY.subarray(3 * j, 3 * j + 3), 3 * i));
  } else if (shown === "error") {
    const name = data.error_names[Number(state.coloring.split("-")[1])];
    colors.x = colored(errors[name], scales.error, onErrorScale);
  } else if (shown === "signed") {
    const sizes = Float32Array.from([...(functions.x ?? []), ...(functions.y ?? [])], Math.abs).sort();
    const limit = sizes[Math.round(WITHIN_SCALE * (sizes.length - 1))] || 1;
    for (const side of sides) {
      if (functions[side]) colors[side] = colored(functions[side], scales.signed, onSignedScale(limit));
    }
    const end = Number(limit.toPrecision(2));
    byId("signed-low").textContent = `≤ −${end}`;
    byId("signed-high").textContent = `≥ ${end}`;
  }
  for (const side of sides) {
    const plain = () => new Uint8Array(bodies[side].positions.length).map((_, i) => data.plain[i % 3]);
    bodies[side].paint(colors[side] ?? plain());
  }
  document.body.dataset.shown = shown;
  document.body.dataset.coloring = state.coloring;
  draw();
}

// ---- Words and marks

const invitation = byId("readout").textContent;

function say(id, text) {
  if (byId(id).textContent !== text) byId(id).textContent = text;
}

function nameFilter() {
  const wavelets = filters - 1;
  const ends = { 1: " (coarsest)", [wavelets]: " (finest)" };
  return state.filter ? `wavelet ${state.filter} of ${wavelets}${ends[state.filter] ?? ""}` : "scaling function";
}

function inWords(error) {
  if (Number.isNaN(error)) return "not known";
  return error === Infinity ? "without end (on another component)" : error.toFixed(4);
}

/** Mark what is picked, and say what the map says of it. */
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
  if (state.coloring === "wavelets" && !entry?.known) {
    if (functions.x && functions.y) text += ` · wavelets alike: cosine ${alikeness(functions.x, functions.y).toFixed(3)}`;
    else if (!state.picked) text = "Point at a body to see the wavelets around that point, and around its match.";
  }
  for (const side of sides) bodies[side].mark(matched()[side]);
  say("readout", text);
  draw();
}

/** Let the pointer, or for good a click, pick a vertex of one side; null for none. */
function pick(side, vertex, pinned = false) {
  state.picked = vertex === null ? null : { side, vertex };
  state.pinned = pinned && vertex !== null;
  if (pinned) byId("vertex").value = state.picked && side === "x" ? vertex : "";
  if (state.coloring === "wavelets" && !shownEntry()?.known) paint();
  tell();
}
const pin = (side, vertex) => pick(side, vertex, true);

function chooseColoring(name) {
  state.coloring = name;
  chooseEntry(null);
}

function chooseMap(index) {
  state.map = index;
  preimages = readPreimages(maps[index]);
  for (const input of document.querySelectorAll("input[name=coloring]")) {
    const of = data.error_names[Number(input.value.split("-")[1])];
    input.disabled = of !== undefined && !Object.hasOwn(maps[index].errors, of);
    // What is not known of this map cannot stay chosen.
    if (input.disabled && state.coloring === input.value) {
      document.querySelector("input[value=transfer]").checked = true;
      state.coloring = "transfer";
    }
  }
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
  const names = functional.pushforward ? ["target", "source"] : ["source", "target"];
  byId("matrix-axes").textContent = `rows: ${names[0]}, columns: ${names[1]}`;
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
    const where = entry.known ? "" : " (not among those this page holds)";
    say("entry", `C(${entry.row}, ${entry.column}) = ${value}: eigenfunction ${entry.x} of the source, ${entry.y} of the target${where}`);
  } else say("entry", "Point at an entry to see its two eigenfunctions.");
}

function chooseEntry(entry, hovered = null) {
  Object.assign(state, { entry, hoveredEntry: hovered });
  paint();
  tell();
  tellEntry();
}

// ---- Cameras

let untouched = true;

function turnTo(body, offset) {
  body.camera.position.copy(offset);
  body.controls.target.set(0, 0, 0);
  body.controls.update();
}

function resetView() {
  const offset = new Vector3().setFromSphericalCoords(1, Math.PI / 2 - data.elevation, data.azimuth);
  const distance = Math.max(...everyBody.map((body) => body.distanceToFit(offset)));
  offset.setLength(distance);
  for (const body of everyBody) {
    body.controls.minDistance = distance / 40;
    body.controls.maxDistance = 4 * distance;
    turnTo(body, offset);
  }
  untouched = true;
}

let leader = null; // the body that the other one follows just now
function follow(body) {
  draw();
  if (!byId("linked").checked || (leader && leader !== body)) return;
  leader = body;
  for (const other of everyBody) {
    if (other === body) continue;
    other.camera.position.copy(body.camera.position);
    other.controls.target.copy(body.controls.target);
    other.controls.update();
  }
  leader = null;
}

const turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const zooms = { "+": 1 / KEY_ZOOM, "=": 1 / KEY_ZOOM, "-": KEY_ZOOM };

function onKey(body, event) {
  if (event.altKey || event.ctrlKey || event.metaKey) return;
  if (turns[event.key] || zooms[event.key]) {
    const [around, over] = turns[event.key] ?? [0, 0];
    const { controls, camera } = body;
    const spherical = new Spherical().setFromVector3(camera.position.clone().sub(controls.target));
    spherical.theta += around * KEY_TURN;
    spherical.phi += over * KEY_TURN;
    spherical.radius *= zooms[event.key] ?? 1;
    spherical.makeSafe();
    camera.position.setFromSpherical(spherical).add(controls.target);
    controls.update();
    untouched = false;
  } else if (event.key === "0" || event.key === "Home") resetView();
  else if (event.key === "Escape") {
    pin("x", null);
    chooseEntry(null);
  }
  else return;
  event.preventDefault();
}

// ---- What the user does

for (const [side, body] of Object.entries(bodies)) {
  const { canvas, controls } = body;
  controls.addEventListener("change", () => follow(body));
  controls.addEventListener("start", () => (untouched = false));
  canvas.addEventListener("keydown", (event) => onKey(body, event));

  let pressed = { x: 0, y: 0 };
  canvas.addEventListener("pointerdown", (event) => (pressed = { x: event.clientX, y: event.clientY }));
  canvas.addEventListener("click", (event) => {
    if (Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) > CLICK_TOLERANCE) return;
    pin(side, body.vertexAt(event));
  });

  let hovered = null; // the newest pointer position not yet looked at
  canvas.addEventListener("pointermove", (event) => {
    if (state.pinned || event.buttons || event.pointerType === "touch") return;
    if (!hovered) {
      requestAnimationFrame(() => {
        if (hovered && !state.pinned) pick(side, body.vertexAt(hovered));
        hovered = null;
      });
    }
    hovered = event;
  });
  canvas.addEventListener("pointerleave", () => {
    hovered = null;
    if (!state.pinned) pick(side, null);
  });
}

// A click, also where the choice stays the same: it leaves eigenfunctions for what was shown before.
for (const input of document.querySelectorAll("input[name=coloring]")) {
  input.addEventListener("click", () => chooseColoring(input.value));
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
    // The first key shows where one is.
    const [across, down] = state.entry ? move : [0, 0];
    chooseEntry([within(row + step * down, matrix.height), within(column + step * across, matrix.width)]);
  } else if (event.key === "Escape") chooseEntry(null);
  else return;
  event.preventDefault();
});
darkness.addEventListener("change", drawMatrix);

byId("reset").addEventListener("click", resetView);
byId("linked").addEventListener("change", () => follow(bodies.x));
byId("vertex").addEventListener("change", ({ target }) => {
  if (target.value === "") pin("x", null);
  else if (target.reportValidity()) pin("x", target.valueAsNumber);
});

// Wide bodies one above the other on a narrow screen, tall ones side by side.
document.body.dataset.shape = data.wide ? "wide" : "tall";

const observer = new ResizeObserver(() => {
  for (const body of everyBody) body.resize();
  if (untouched) resetView();
  // At once: resizing has emptied the canvas.
  for (const body of everyBody) body.render();
});
for (const body of everyBody) observer.observe(body.canvas);

// Some browsers remember choices over a reload.
const chosen = (name) => document.querySelector(`input[name=${name}]:checked`)?.value;
state.coloring = chosen("coloring");
byId("filter").disabled = filters < 2;
chooseFilter();
chooseMap(Number(chosen("map") ?? 0));

// For scripts and tests: mark a source vertex, see what is marked, what is shown, and where a vertex is in the
// window.
window.jaxsmw = {
  pick: (vertex) => pin("x", vertex),
  project: (side, vertex) => bodies[side].project(vertex),
  colors: (side) => Array.from(bodies[side].colors),
  get functions() {
    return { x: functions.x && Array.from(functions.x), y: functions.y && Array.from(functions.y) };
  },
  get state() {
    const { map, coloring, filter, pinned, entry } = state;
    return { source: bodies.x.marked, target: bodies.y.marked, map: maps[map].name, coloring, filter, pinned, entry };
  },
};
