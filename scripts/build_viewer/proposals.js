// Proposals for landmarks: where a map sends a point, and where a landmark would help most. Also the placement of a
// mesh on the page.

import { distanceBetween } from "./surface.js";

const TOGETHER = 0.1; // matches of one triangle that are closer than this share of the diagonal are averaged
const NEIGHBOURHOOD = 0.03; // the radius of the average of expected errors, as a share of the diagonal
const APART = 0.12; // the least distance of a suggestion from other landmarks, as a share of the diagonal

/** The similarity between a mesh on the page and its file: file = page · matrix + offset, in float64. */
export class Placement {
  constructor({ matrix, offset }) {
    Object.assign(this, { matrix, offset, scale: Math.hypot(...matrix[0]) });
  }

  toFile(point) {
    return [0, 1, 2].map((axis) => this.offset[axis] + point.reduce((sum, entry, i) => sum + entry * this.matrix[i][axis], 0));
  }

  toPage(point) {
    const moved = point.map((entry, axis) => entry - this.offset[axis]);
    // The matrix is a rotation times the scale.
    return this.matrix.map((row) => row.reduce((sum, entry, axis) => sum + entry * moved[axis], 0) / this.scale ** 2);
  }
}

/** The point of the other body to which a pointwise map from the source to the target sends a point of one side. */
export function sendPoint(side, point, source, target, pointwise) {
  const [from, to] = side === "x" ? [source, target] : [target, source];
  const vertices = side === "x" ? from.corners(point).map((corner) => pointwise[corner]) : sourcesNear(from.position(point), target, pointwise);
  const nearest = side === "x" ? pointwise[from.nearestCorner(point)] : central(vertices, source);
  const spread = Math.max(...vertices.map((vertex) => distanceBetween(to.vertex(vertex), to.vertex(nearest))));
  if (spread > TOGETHER * to.diagonal) return to.nearest(to.vertex(nearest));
  const weights = side === "x" ? point.weights : vertices.map(() => 1 / vertices.length);
  const mean = [0, 1, 2].map((axis) => vertices.reduce((sum, vertex, i) => sum + weights[i] * to.vertex(vertex)[axis], 0));
  const { face, weights: found } = to.nearest(mean);
  return { face, weights: found };
}

/** The source vertices whose match is nearest to a position on the target. */
function sourcesNear(position, target, pointwise) {
  const distances = Float64Array.from(pointwise, (vertex) => distanceBetween(position, target.vertex(vertex)));
  const least = distances.reduce((a, b) => Math.min(a, b), Infinity);
  return Array.from(distances.keys()).filter((vertex) => distances[vertex] === least);
}

/** The vertex that is nearest to the mean of the vertices. */
function central(vertices, shape) {
  const mean = [0, 1, 2].map((axis) => vertices.reduce((sum, vertex) => sum + shape.vertex(vertex)[axis], 0) / vertices.length);
  const distances = vertices.map((vertex) => distanceBetween(mean, shape.vertex(vertex)));
  return vertices[distances.indexOf(Math.min(...distances))];
}

/** Suggests points of the source, the highest expected error first. */
export class Suggestions {
  #smoothed = null;
  #errors = null; // the errors that #smoothed belongs to
  #made = [];

  constructor(shape) {
    this.shape = shape;
  }

  /** The vertex with the highest smoothed error that is far from all landmarks and from earlier suggestions. */
  next(errors, landmarks) {
    const { shape } = this;
    if (errors !== this.#errors) {
      this.#made = [];
      this.#errors = errors;
      // An infinite error, of a match on a separate component, counts as the largest finite error.
      const largest = errors.reduce((most, error) => (error < Infinity && error > most ? error : most), 0) || 1;
      const finite = errors.map((error) => Math.min(error, largest));
      this.#smoothed = shape.smooth(finite, NEIGHBOURHOOD * shape.diagonal);
    }
    const taken = [...landmarks.map((point) => shape.nearestCorner(point)), ...this.#made];
    const near = shape.within(taken, APART * shape.diagonal);
    let vertex = -1;
    this.#smoothed.forEach((error, i) => {
      if (!near[i] && !Number.isNaN(error) && !(error <= this.#smoothed[vertex])) vertex = i;
    });
    if (vertex < 0) return null;
    this.#made.push(vertex);
    return { vertex, error: this.#smoothed[vertex], point: shape.atVertex(vertex) };
  }
}
