// Geometry on a triangle mesh in float64: points on triangles, nearest points, distances along edges, and smoothing.

/** The point of the triangle a, b, c nearest to p, as barycentric weights (Ericson, "Real-Time Collision Detection"). */
function nearestWeights(p, a, b, c) {
  const ab = minus(b, a), ac = minus(c, a), ap = minus(p, a), bp = minus(p, b), cp = minus(p, c);
  const d1 = dot(ab, ap), d2 = dot(ac, ap), d3 = dot(ab, bp), d4 = dot(ac, bp), d5 = dot(ab, cp), d6 = dot(ac, cp);
  if (d1 <= 0 && d2 <= 0) return [1, 0, 0];
  if (d3 >= 0 && d4 <= d3) return [0, 1, 0];
  if (d6 >= 0 && d5 <= d6) return [0, 0, 1];
  const va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2;
  if (vc <= 0 && d1 >= 0 && d3 <= 0) return share(d1, d1 - d3, (t) => [1 - t, t, 0]);
  if (vb <= 0 && d2 >= 0 && d6 <= 0) return share(d2, d2 - d6, (t) => [1 - t, 0, t]);
  if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) return share(d4 - d3, d4 - d3 + d5 - d6, (t) => [0, 1 - t, t]);
  const total = va + vb + vc;
  return [va / total, vb / total, vc / total];
}

const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const share = (part, whole, weights) => weights(whole > 0 ? part / whole : 0);

export const distanceBetween = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);

const MOST_AVERAGES = 50; // keeps smoothing fast on fine meshes

// Evenly spread directions (a Fibonacci sphere).
const DIRECTIONS = Array.from({ length: 120 }, (_, i) => {
  const z = 1 - (2 * i + 1) / 120, r = Math.sqrt(1 - z * z), angle = i * Math.PI * (3 - Math.sqrt(5));
  return [r * Math.cos(angle), z, r * Math.sin(angle)];
});

/** A triangle mesh. A point on its surface is { face, weights }, with three barycentric weights. */
export class Surface {
  #balls = null;
  #neighbours = null;

  constructor(positions, faces) {
    this.positions = positions;
    this.faces = faces;
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (const vertex of faces) {
      for (let axis = 0; axis < 3; axis++) {
        low[axis] = Math.min(low[axis], positions[3 * vertex + axis]);
        high[axis] = Math.max(high[axis], positions[3 * vertex + axis]);
      }
    }
    this.diagonal = distanceBetween(low, high);
  }

  vertex(index) {
    return [this.positions[3 * index], this.positions[3 * index + 1], this.positions[3 * index + 2]];
  }

  corners({ face }) {
    return [this.faces[3 * face], this.faces[3 * face + 1], this.faces[3 * face + 2]];
  }

  position(point) {
    const [a, b, c] = this.corners(point).map((corner) => this.vertex(corner));
    const [u, v, w] = point.weights;
    return [0, 1, 2].map((axis) => u * a[axis] + v * b[axis] + w * c[axis]);
  }

  /** The unit normal of the triangle of a point. */
  normal(point) {
    const [a, b, c] = this.corners(point).map((corner) => this.vertex(corner));
    const u = minus(b, a), v = minus(c, a);
    const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    const length = Math.hypot(...normal) || 1;
    return normal.map((entry) => entry / length);
  }

  /** The corner of the point's triangle that is nearest to the point. */
  nearestCorner(point) {
    const position = this.position(point), corners = this.corners(point);
    const distances = corners.map((corner) => distanceBetween(position, this.vertex(corner)));
    return corners[distances.indexOf(Math.min(...distances))];
  }

  /** The direction nearest to a point's normal from which the point is visible. */
  viewOf(point) {
    const normal = this.normal(point), position = this.position(point);
    const directions = [normal, ...DIRECTIONS].filter((direction) => dot(direction, normal) > 0.1);
    directions.sort((a, b) => dot(b, normal) - dot(a, normal));
    return directions.find((direction) => this.#isOpen(position, direction)) ?? normal;
  }

  /** Whether a ray from a point of the surface meets no other part of the surface. */
  #isOpen(position, direction) {
    const balls = this.balls, near = 0.01 * this.diagonal;
    for (let face = 0, at = 0; face < this.faces.length / 3; face++, at += 4) {
      const to = [balls[at] - position[0], balls[at + 1] - position[1], balls[at + 2] - position[2]];
      const along = dot(to, direction);
      // Balls instead of triangles: a ray that nearly touches the surface does not count as open.
      if (along > near + balls[at + 3] && dot(to, to) - along * along < balls[at + 3] ** 2) return false;
    }
    return true;
  }

  onFace(face, position) {
    const corners = this.corners({ face }).map((corner) => this.vertex(corner));
    return { face, weights: nearestWeights(position, ...corners) };
  }

  /** The surface point of a vertex that has a triangle. */
  atVertex(vertex) {
    const corner = this.faces.indexOf(vertex);
    const weights = [0, 0, 0];
    weights[corner % 3] = 1;
    return { face: Math.floor(corner / 3), weights };
  }

  /** The nearest point of the surface, with its distance. */
  nearest(position) {
    const balls = this.balls;
    let best = { distance: Infinity };
    for (let face = 0, at = 0; face < this.faces.length / 3; face++, at += 4) {
      const reach = best.distance + balls[at + 3];
      const x = position[0] - balls[at], y = position[1] - balls[at + 1], z = position[2] - balls[at + 2];
      if (x * x + y * y + z * z >= reach * reach) continue;
      const point = this.onFace(face, position);
      const distance = distanceBetween(position, this.position(point));
      if (distance < best.distance) best = { ...point, distance };
    }
    return best;
  }

  /** For each triangle, a ball around it: the centre and the radius. */
  get balls() {
    if (this.#balls) return this.#balls;
    this.#balls = new Float64Array((4 * this.faces.length) / 3);
    const { faces, positions } = this, balls = this.#balls;
    for (let first = 0, at = 0; first < faces.length; first += 3, at += 4) {
      for (let corner = first; corner < first + 3; corner++) {
        for (let axis = 0; axis < 3; axis++) balls[at + axis] += positions[3 * faces[corner] + axis] / 3;
      }
      for (let corner = first; corner < first + 3; corner++) {
        const v = 3 * faces[corner];
        const x = positions[v] - balls[at], y = positions[v + 1] - balls[at + 1], z = positions[v + 2] - balls[at + 2];
        balls[at + 3] = Math.max(balls[at + 3], Math.sqrt(x * x + y * y + z * z));
      }
    }
    return this.#balls;
  }

  /** The neighbours of vertex i: `list` from starts[i] to starts[i + 1]. A neighbour can occur twice. */
  get neighbours() {
    if (this.#neighbours) return this.#neighbours;
    const starts = new Uint32Array(this.positions.length / 3 + 1);
    for (const vertex of this.faces) starts[vertex + 1] += 2;
    for (let i = 1; i < starts.length; i++) starts[i] += starts[i - 1];
    const list = new Uint32Array(2 * this.faces.length), next = starts.slice();
    for (let at = 0; at < this.faces.length; at += 3) {
      for (let corner = 0; corner < 3; corner++) {
        const vertex = this.faces[at + corner];
        list[next[vertex]++] = this.faces[at + ((corner + 1) % 3)];
        list[next[vertex]++] = this.faces[at + ((corner + 2) % 3)];
      }
    }
    return (this.#neighbours = { starts, list });
  }

  /** Marks the vertices within a distance of the given vertices, along edges. */
  within(vertices, radius) {
    const { starts, list } = this.neighbours;
    const distances = new Float64Array(this.positions.length / 3).fill(Infinity);
    const queue = [...vertices];
    for (const vertex of vertices) distances[vertex] = 0;
    // A vertex enters the queue again when its distance decreases.
    for (let head = 0; head < queue.length; head++) {
      const vertex = queue[head];
      for (let at = starts[vertex]; at < starts[vertex + 1]; at++) {
        const distance = distances[vertex] + distanceBetween(this.vertex(vertex), this.vertex(list[at]));
        if (distance >= distances[list[at]] || distance > radius) continue;
        distances[list[at]] = distance;
        queue.push(list[at]);
      }
    }
    return Uint8Array.from(distances, (distance) => distance < Infinity);
  }

  /** The values, averaged over a neighbourhood of about this radius, or less on very fine meshes. Unknown values (NaN) have no weight. */
  smooth(values, radius) {
    const { starts, list } = this.neighbours;
    let length = 0;
    for (let at = 0; at < this.faces.length; at += 3) {
      length += distanceBetween(this.vertex(this.faces[at]), this.vertex(this.faces[at + 1]));
    }
    // The reach of repeated averages grows with the square root of their number.
    const repetitions = Math.min(MOST_AVERAGES, Math.max(1, Math.round((radius / (length / (this.faces.length / 3))) ** 2)));
    let weights = Float64Array.from(values, (value) => Number(Number.isFinite(value)));
    let sums = Float64Array.from(values, (value) => (Number.isFinite(value) ? value : 0));
    const average = (of) => {
      const result = new Float64Array(of.length);
      for (let i = 0; i < of.length; i++) {
        let sum = of[i];
        for (let at = starts[i]; at < starts[i + 1]; at++) sum += of[list[at]];
        result[i] = sum / (1 + starts[i + 1] - starts[i]);
      }
      return result;
    };
    for (let i = 0; i < repetitions; i++) [weights, sums] = [average(weights), average(sums)];
    return sums.map((sum, i) => (weights[i] > 0 && starts[i + 1] > starts[i] ? sum / weights[i] : NaN));
  }
}
