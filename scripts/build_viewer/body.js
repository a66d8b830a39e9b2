// One body in its canvas, which all pages share: the surface, the lights, the camera and the marks.

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
import { Surface } from "./surface.js";

const FIELD_OF_VIEW = 25;
// The caption covers the top of the canvas. The body may use this share of the upper half.
const BELOW_CAPTION = 0.85;
const KEY_TURN = Math.PI / 18;
const KEY_ZOOM = 1.15;
const HIDDEN = 0.01; // a point is hidden if the surface is in front of it by this share of the diagonal

export const decode = (text, Type) => new Type(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);

// The light intensity of each byte of a screen colour. three.js interpolates and shades light intensities.
const LINEAR = Float32Array.from({ length: 256 }, (_, byte) => new Color().setRGB(byte / 255, 0, 0, SRGBColorSpace).r);

// Marks are white with a black rim, visible on every colour, and faint where the body hides them.
const CORE = new SphereGeometry(1, 20, 14);
const RIM = new SphereGeometry(1.5, 20, 14);
const MARK_LOOKS = [
  [RIM, new MeshBasicMaterial({ color: 0x000000, side: BackSide })],
  [CORE, new MeshBasicMaterial({ color: 0xffffff })],
  [CORE, new MeshBasicMaterial({ color: 0xffffff, transparent: true, opacity: 0.4, depthTest: false })],
];

/** One body in its canvas: the surface, the lights, the camera and the marks. */
export class Body {
  #areas = null;

  constructor(canvas, positions, faces) {
    this.canvas = canvas;
    this.renderer = new WebGLRenderer({ canvas, alpha: true, antialias: true });
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.05, 100);
    this.scene.add(this.camera);
    this.#light();

    this.positions = positions;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(this.positions, 3));
    geometry.setAttribute("color", new BufferAttribute(new Float32Array(this.positions.length), 3));
    geometry.setIndex(new BufferAttribute(faces, 1));
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
    this.overlays = []; // further objects in the scene, which are placed before each picture
    this.shape = new Surface(positions, faces);
  }

  /** Adds lamps that move with the viewer, so that the visible side is always well lit. */
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

  /** Moves the vertices to new positions. */
  move(positions) {
    this.positions.set(positions);
    this.#areas = null;
    const { geometry } = this.surface;
    geometry.attributes.position.needsUpdate = true;
    geometry.computeVertexNormals();
    geometry.computeBoundingSphere();
    this.shape = new Surface(this.positions, geometry.index.array);
  }

  vertex(index) {
    return new Vector3().fromArray(this.positions, 3 * index);
  }

  /** Colours the vertices, with three bytes each. */
  paint(colors) {
    this.colors = colors;
    const attribute = this.surface.geometry.attributes.color;
    for (let i = 0; i < colors.length; i++) attribute.array[i] = LINEAR[colors[i]];
    attribute.needsUpdate = true;
  }

  /** The barycentric areas of the vertices. */
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

  /** Marks these vertices and removes all other marks. */
  mark(indices) {
    this.marked = indices;
    for (const mark of this.marks) {
      this.scene.remove(mark);
      mark.dispose();
    }
    this.marks = MARK_LOOKS.map((look) => new InstancedMesh(...look, indices.length));
    // Marks move after three.js has decided which objects are in view.
    for (const mark of this.marks) mark.frustumCulled = false;
    if (indices.length) this.scene.add(...this.marks);
  }

  /** The length at a point of the scene that covers one pixel of the screen. */
  pixelAt(point) {
    const height = (2 * Math.tan((FIELD_OF_VIEW * Math.PI) / 360)) / this.canvas.clientHeight;
    return height * this.camera.position.distanceTo(point);
  }

  /** Places the marks so that they keep their size on the screen at every distance. */
  #placeMarks() {
    const pixels = this.marked.length > 1 ? 4.5 : 6;
    this.marked.forEach((index, i) => {
      const center = this.vertex(index);
      const towards = this.camera.position.clone().sub(center);
      const radius = pixels * this.pixelAt(center);
      // Move the mark towards the viewer, so that the surface does not cut into it.
      center.addScaledVector(towards.normalize(), 2 * radius);
      const matrix = new Matrix4().makeScale(radius, radius, radius).setPosition(center);
      for (const mark of this.marks) mark.setMatrixAt(i, matrix);
    });
    for (const mark of this.marks) mark.instanceMatrix.needsUpdate = true;
  }

  /** The distance from which the whole body is visible, seen from the direction of `offset`. */
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

  /** Moves the camera to this offset from the origin, and turns it to the origin. */
  lookFrom(offset) {
    this.camera.position.copy(offset);
    this.controls.target.set(0, 0, 0);
    this.controls.update();
  }

  /** The point of the surface under the pointer, as { face, weights }, or null. */
  pointAt(event) {
    const hit = this.#hit(event);
    return hit && this.shape.onFace(hit.faceIndex, hit.point.toArray());
  }

  /** The vertex under the pointer, or null. */
  vertexAt(event) {
    const point = this.pointAt(event);
    return point && this.shape.nearestCorner(point);
  }

  /** Whether the surface hides a point on it from the camera. */
  hides(position) {
    const { x, y } = this.projectPoint(position);
    const hit = this.#hit({ clientX: x, clientY: y });
    const distance = this.camera.position.distanceTo(new Vector3(...position));
    return Boolean(hit) && hit.distance < distance - HIDDEN * this.shape.diagonal;
  }

  #hit(event) {
    const box = this.canvas.getBoundingClientRect();
    const x = (2 * (event.clientX - box.left)) / box.width - 1;
    const y = 1 - (2 * (event.clientY - box.top)) / box.height;
    const raycaster = new Raycaster();
    raycaster.setFromCamera(new Vector2(x, y), this.camera);
    return raycaster.intersectObject(this.surface)[0] ?? null;
  }

  /** The position of a vertex in the window, in CSS pixels. */
  project(index) {
    return this.projectPoint(this.vertex(index).toArray());
  }

  projectPoint(position) {
    const box = this.canvas.getBoundingClientRect();
    this.camera.updateMatrixWorld();
    const { x, y } = new Vector3(...position).project(this.camera);
    return { x: box.left + ((x + 1) / 2) * box.width, y: box.top + ((1 - y) / 2) * box.height };
  }

  resize(width = this.canvas.clientWidth, height = this.canvas.clientHeight) {
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
  }

  render() {
    this.#placeMarks();
    for (const overlay of this.overlays) overlay.place();
    this.renderer.render(this.scene, this.camera);
  }
}

export const turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const zooms = { "+": 1 / KEY_ZOOM, "=": 1 / KEY_ZOOM, "-": KEY_ZOOM };

/** Turns or zooms the camera of a body. Returns whether the key does so. */
export function moveByKey({ camera, controls }, key) {
  if (!turns[key] && !zooms[key]) return false;
  const [around, over] = turns[key] ?? [0, 0];
  const spherical = new Spherical().setFromVector3(camera.position.clone().sub(controls.target));
  spherical.theta += around * KEY_TURN;
  spherical.phi += over * KEY_TURN;
  spherical.radius *= zooms[key] ?? 1;
  spherical.makeSafe();
  camera.position.setFromSpherical(spherical).add(controls.target);
  controls.update();
  return true;
}
