// The interactive page: two bodies to turn, and the map between their vertices under the pointer.
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
const KEY_TURN = Math.PI / 18;
const KEY_ZOOM = 1.15;
const CLICK_TOLERANCE = 5; // pixels that the pointer may move between press and release
const NAMED_VERTICES = 12; // of those mapped to one target vertex

const byId = (id) => document.getElementById(id);
const data = JSON.parse(byId("data").textContent);
const decode = (text, Type) => new Type(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);

// Screen colours in bytes to the light intensities that three.js interpolates and shades.
const LINEAR = Float32Array.from({ length: 256 }, (_, byte) => new Color().setRGB(byte / 255, 0, 0, SRGBColorSpace).r);

const pointwiseMap = decode(data.map, Uint32Array);
const errors = (data.errors ?? []).map(({ name, values, colors }) => ({
  name: name.toLowerCase(),
  values: decode(values, Float32Array),
  colors: decode(colors, Uint8Array),
}));

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
    const attribute = this.surface.geometry.attributes.color;
    for (let i = 0; i < colors.length; i++) attribute.array[i] = LINEAR[colors[i]];
    attribute.needsUpdate = true;
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
      distance = Math.max(distance, z + Math.abs(y) / half, z + Math.abs(x) / (half * this.camera.aspect));
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

// ---- Colours

const colorsY = decode(data.colors, Uint8Array);
const colorsX = new Uint8Array(3 * pointwiseMap.length);
pointwiseMap.forEach((j, i) => colorsX.set(colorsY.subarray(3 * j, 3 * j + 3), 3 * i));
const plain = (body) => new Uint8Array(body.positions.length).map((_, i) => data.plain[i % 3]);
const colorings = {
  transfer: { x: colorsX, y: colorsY },
  plain: { x: plain(bodies.x), y: plain(bodies.y) },
};
errors.forEach(({ colors }, i) => (colorings[`error-${i}`] = { x: colors, y: colorings.plain.y }));

let coloring;
function color(name) {
  coloring = name;
  for (const side of ["x", "y"]) bodies[side].paint(colorings[name][side]);
  document.body.dataset.coloring = name;
  draw();
}

// ---- Marks

// The source vertices of each target vertex, one after the other; those of j begin at starts[j].
const starts = new Uint32Array(colorsY.length / 3 + 1);
for (const j of pointwiseMap) starts[j + 1]++;
for (let j = 1; j < starts.length; j++) starts[j] += starts[j - 1];
const sources = new Uint32Array(pointwiseMap.length);
const next = starts.slice();
pointwiseMap.forEach((j, i) => (sources[next[j]++] = i));

const invitation = byId("readout").textContent;
let pinned = false;

/** Mark a vertex of one side (or none: null) and what the map says of it. */
function show(side, vertex) {
  const marks = { x: [], y: [] };
  let text = invitation;
  if (vertex !== null && side === "x") {
    marks.x = [vertex];
    marks.y = [pointwiseMap[vertex]];
    text = `Source vertex ${vertex} → target vertex ${marks.y[0]}`;
    for (const { name, values } of errors) {
      text += ` · ${name} ${Number.isNaN(values[vertex]) ? "not known" : values[vertex].toFixed(4)}`;
    }
  } else if (vertex !== null) {
    marks.x = Array.from(sources.subarray(starts[vertex], starts[vertex + 1]));
    marks.y = [vertex];
    const named = marks.x.slice(0, NAMED_VERTICES).join(", ") + (marks.x.length > NAMED_VERTICES ? ", …" : "");
    const count = marks.x.length === 1 ? "source vertex" : `${marks.x.length} source vertices:`;
    text = `Target vertex ${vertex} ← ${marks.x.length ? `${count} ${named}` : "no source vertex"}`;
  }
  for (const key of ["x", "y"]) bodies[key].mark(marks[key]);
  if (byId("readout").textContent !== text) byId("readout").textContent = text;
  draw();
}

function pin(side, vertex) {
  pinned = vertex !== null;
  byId("vertex").value = pinned && side === "x" ? vertex : "";
  show(side, vertex);
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
  else if (event.key === "Escape") pin("x", null);
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
    if (pinned || event.buttons || event.pointerType === "touch") return;
    if (!hovered) {
      requestAnimationFrame(() => {
        if (hovered && !pinned) show(side, body.vertexAt(hovered));
        hovered = null;
      });
    }
    hovered = event;
  });
  canvas.addEventListener("pointerleave", () => {
    hovered = null;
    if (!pinned) show(side, null);
  });
}

for (const input of document.querySelectorAll("input[name=coloring]")) {
  input.addEventListener("change", () => color(input.value));
}
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

// Some browsers remember the choice over a reload.
color(document.querySelector("input[name=coloring]:checked").value);

// For scripts and tests: mark a source vertex, see what is marked and where a vertex is in the window.
window.jaxsmw = {
  pick: (vertex) => pin("x", vertex),
  project: (side, vertex) => bodies[side].project(vertex),
  get state() {
    return { source: bodies.x.marked, target: bodies.y.marked, pinned, coloring };
  },
};
