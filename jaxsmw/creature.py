"""Procedural creatures, which are synthetic shapes with exact ground truth.

A creature is an implicit surface: a smooth union of tapered tubes around a skeleton. The surface is exactly
mirror symmetric in the rest pose. Marching cubes, decimation and relaxation on the surface give well-shaped
triangles. Rotations of the joints deform the rest pose smoothly into the other poses. Two points of a
creature in two poses correspond if they have the same position in the rest pose.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np
from jaxtyping import Int64
from scipy.interpolate import PchipInterpolator
from scipy.sparse import coo_array
from scipy.spatial.transform import Rotation

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.surface_points import SurfacePoints

_Vector = tuple[float, float, float]

_MINIMUM_VERTICES = 500
_REACH = 0.25  # larger values of the implicit function only show that a point is outside
_STIFFNESS = 4.0  # a larger value makes the skin bend more abruptly between the bones
_MIRROR = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True)
class CreaturePair:
    """Two meshes of one synthetic creature in two poses, with the exact ground truth; see `creature_pair`.

    **Attributes:**

    - `source`, `target`: the source (m vertices) and the target, which are triangulated independently.
    - `truth`: the ground truth as m `SurfacePoints` on the target, one for each source vertex.
    """

    source: Mesh
    target: Mesh
    truth: SurfacePoints

    @cached_property
    def true_map(self) -> Int64[np.ndarray, " m"]:
        """The nearest corner of each point of `truth`: a pointwise map (m,), 0-based target vertices."""
        return self.truth.nearest_corners(self.target)


@dataclass(frozen=True)
class _Tube:
    """A chain of tapered capsules (convex hulls of two balls); with a `normal`, a flat plate."""

    centers: np.ndarray  # (p, 3)
    radii: np.ndarray  # (p,)
    blend: float  # the width of the smooth transition to the rest of the body
    carved: bool  # whether the tube is subtracted from the body instead of added to it
    normal: np.ndarray | None  # (3,), the unit normal of a plate; None for tubes
    thickness: float  # half the thickness of a plate

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance (p,) from points (p, 3) to the nearest capsule of the chain."""
        result = np.full(len(points), np.inf)
        for i, axis in enumerate(np.diff(self.centers, axis=0)):
            relative = planar = points - self.centers[i]
            run = axis
            if self.normal is not None:
                planar = relative - (relative @ self.normal)[:, None] * self.normal
                run = axis - (axis @ self.normal) * self.normal
            length = np.linalg.norm(run)
            taper = self.radii[i] - self.radii[i + 1]
            sine = np.clip(taper / length, -0.95, 0.95)  # at 1 or -1, one ball contains the other ball
            along = planar @ (run / length)
            across = np.sqrt(np.maximum(np.einsum("ij,ij->i", planar, planar) - along**2, 0))
            position = np.clip((along - across * sine / np.sqrt(1 - sine**2)) / length, 0, 1)
            offset = np.hypot(along - position * length, across)
            radius = self.radii[i] - position * taper
            if self.normal is not None:
                half = np.minimum(self.thickness, radius)
                height = relative @ self.normal - position * (axis @ self.normal)
                offset, radius = np.hypot(np.maximum(offset - radius + half, 0), height), half
            result = np.minimum(result, offset - radius)
        return result


def _smooth_minimum(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Return the minimum of a and b, smoothed by a parabola where a and b differ by less than `width`."""
    overlap = np.maximum(1 - np.abs(a - b) / width, 0)
    return np.minimum(a, b) - overlap**2 * (width / 4)


class _Body:
    """The body of one individual in the rest pose, as an implicit surface around a skeleton."""

    # The x axis points to the body's left, the y axis up and the z axis forward. Parts away from the plane
    # x = 0 are added on both sides, and their joints are called left_… and right_…. A smooth random function
    # of position warps all proportions.

    def __init__(self, random: np.random.Generator) -> None:
        self.joints: dict[str, int] = {}
        self.parents: list[int] = []
        self._pivots: list[np.ndarray] = []
        self._guides: list[tuple[int, np.ndarray]] = []  # a joint, and two balls that the joint moves
        self._tubes: list[_Tube] = []
        self._scale = np.exp(0.05 * random.normal(size=4))
        self._frequencies = 1.5 * random.normal(size=(3, 4))
        self._phases = random.uniform(0, 2 * np.pi, size=4)
        self._amplitudes = 0.03 * random.normal(size=(4, 4))

    def _individual(self, balls: str) -> np.ndarray:
        """Parse p balls, written as "x y z radius, ...", and scale them to this creature's proportions."""
        chain = np.array([ball.split() for ball in balls.split(",")], dtype=float)
        across, up, ahead = (
            chain[:, i, None] * self._frequencies[i] + (i > 0) * self._phases for i in range(3)
        )
        # The warp is an even function of x, so both sides of the body are equal.
        waves = np.cos(across) * np.sin(up + ahead) @ self._amplitudes
        chain[:, [0, 3]] *= np.exp(waves[:, [0, 3]])
        chain[:, [1, 2]] += waves[:, [1, 2]]
        return chain * self._scale

    def add(
        self,
        balls: str,
        *,
        blend: float,
        carved: bool = False,
        normal: _Vector | None = None,
        thickness: float = 0.0,
        joint: str = "",
    ) -> None:
        """Add a tube or plate, or carve a tube out. A part that projects far needs the name of its joint."""
        chain = self._individual(balls)
        if joint:
            for prefix, side in self._sides(chain):
                owner = self.joints[prefix + joint if prefix + joint in self.joints else joint]
                self._guides += [(owner, hull) for hull in _hulls(side)]
        if len(chain) > 2:  # interpolation rounds the corners of the chain
            knots = np.r_[0, np.linalg.norm(np.diff(chain[:, :3], axis=0), axis=1).cumsum()]
            fine = np.interp(np.linspace(0, len(chain) - 1, 3 * len(chain) - 2), np.arange(len(chain)), knots)
            chain = PchipInterpolator(knots, chain)(fine)
        unit = None if normal is None else np.array(normal) / np.linalg.norm(normal)
        self._tubes.append(_Tube(chain[:, :3], chain[:, 3], blend, carved, unit, thickness))

    def limb(self, joints: str, parent: str, balls: str, *, blend: float) -> None:
        """Add a tube that has a joint in each ball except the last ball."""
        for prefix, side in self._sides(self._individual(balls)):
            above = self.joints.get(prefix + parent, self.joints.get(parent, -1))
            for name, hull in zip(joints.split(), _hulls(side), strict=True):
                self.joints[prefix + name] = len(self.parents)
                self.parents.append(above)
                above = len(self._pivots)
                self._pivots.append(hull[0, :3])
                self._guides.append((above, hull))
        self.add(balls, blend=blend)

    def _sides(self, chain: np.ndarray) -> list[tuple[str, np.ndarray]]:
        if chain[:, 0].any():
            return [("left_", chain), ("right_", chain * np.r_[_MIRROR, 1])]
        return [("", chain)]

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return values (p,) that are negative inside the body, and distances to the skin up to `_REACH`."""
        folded = np.stack([np.abs(points[:, 0]), points[:, 1], points[:, 2]])
        result = np.full(len(points), 2 * _REACH)
        for tube in self._tubes:
            margin = tube.radii.max() + tube.blend + _REACH
            low, high = tube.centers.min(0) - margin, tube.centers.max(0) + margin
            inside = [(c > a) & (c < b) for c, a, b in zip(folded, low, high, strict=True)]
            near = np.flatnonzero(inside[0] & inside[1] & inside[2])
            if not len(near):
                continue
            local = folded[:, near].T
            distance = tube.distance(local)
            if low[0] < 0 and tube.centers[:, 0].any():  # the mirror image crosses the plane x = 0
                distance = _smooth_minimum(distance, tube.distance(local * _MIRROR), tube.blend)
            if tube.carved:
                result[near] = -_smooth_minimum(-result[near], distance, tube.blend)
            else:
                result[near] = _smooth_minimum(result[near], distance, tube.blend)
        return result

    @property
    def extent(self) -> float:
        """A radius r such that the ball of radius r around the origin contains the body."""
        return max(np.linalg.norm(t.centers, axis=1).max() + t.radii.max() for t in self._tubes)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Move points one Newton step toward the skin; return the new points and their unit normals."""
        width = 1e-6
        stencil = points + width * np.vstack([np.zeros(3), np.eye(3)])[:, None]
        value, *shifted = self.signed_distance(stencil.reshape(-1, 3)).reshape(4, -1)
        gradient = (np.stack(shifted, axis=1) - value[:, None]) / width
        length = np.maximum(np.linalg.norm(gradient, axis=1), 0.5)
        normals = gradient / length[:, None]
        return points - np.clip(value / length, -0.03, 0.03)[:, None] * normals, normals

    def angles(self, pose: str, random: np.random.Generator) -> np.ndarray:
        """Return the rotation vectors (j, 3) of the joints in radians, with small random changes."""
        # `pose` lists joints with up to three angles in degrees, for rotations about the x, y and z axes. At
        # the head, positive angles turn the nose down (x), turn the nose to the left (y), and raise the left
        # side (z). The name of a paired joint without `left_` or `right_` stands for both joints. The
        # rotation of the right joint is then mirrored.
        angles = np.zeros((len(self.parents), 3))
        for name, *turn in (entry.split() for entry in pose.split(";")):
            degrees = np.array([*turn, 0, 0][:3], dtype=float)
            for prefix, sign in (("", 1), ("left_", 1), ("right_", -_MIRROR)):
                if prefix + name in self.joints:
                    angles[self.joints[prefix + name]] += degrees * sign
        angles *= np.exp(0.1 * random.normal(size=(len(angles), 1)))
        return np.radians(angles + 2 * random.normal(size=angles.shape))

    def posed(self, points: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Return the positions of points (p, 3) after the rotations of the joints."""
        # Each joint rotates each point by a share of its angle. Averaging rotation matrices instead of angles
        # would shrink the skin around a flexed joint and collapse it around a twisted joint.
        shares = np.zeros((len(points), len(angles)))
        for joint, hull in self._guides:
            center, axis = hull[0], hull[1] - hull[0]
            position = np.clip((points - center[:3]) @ axis[:3] / (axis[:3] @ axis[:3]), 0, 1)
            nearest = center + position[:, None] * axis
            depth = np.linalg.norm(points - nearest[:, :3], axis=1) / nearest[:, 3]
            shares[:, joint] += np.exp(-_STIFFNESS * depth)
        shares /= shares.sum(axis=1, keepdims=True)
        for joint in range(len(angles) - 1, 0, -1):  # a joint also moves the parts of all its descendants
            shares[:, self.parents[joint]] += shares[:, joint]
        for joint in range(len(angles) - 1, -1, -1):
            turn = Rotation.from_rotvec(shares[:, joint, None] * angles[joint])
            points = turn.apply(points - self._pivots[joint]) + self._pivots[joint]
        return points


def _hulls(chain: np.ndarray) -> np.ndarray:
    """Return the consecutive pairs of balls (p - 1, 2, 4) of a chain of p balls."""
    return np.stack([chain[:-1], chain[1:]], axis=1)


def _isosurface(body: _Body, spacing: float, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate the skin by marching cubes on a random grid, which is refined only near the skin."""
    turn, shift = Rotation.from_quat(random.normal(size=4)).as_matrix(), random.uniform(size=3)
    square = [(0, 0), (1, 0), (1, 1), (0, 1)]
    corners = np.array([(*corner, top) for top in (0, 1) for corner in square])
    # A cell can contain skin only if the implicit function at its centre is below 1.3 cell widths in absolute
    # value. Half the diagonal of a cell is only 0.87 cell widths, but the implicit function can overestimate
    # distances.
    level = int(np.log2(_REACH / (1.3 * spacing)))
    extent = int(np.ceil(body.extent / spacing / 2**level)) + 1
    cells = np.stack(np.meshgrid(*[np.arange(-extent, extent)] * 3), axis=-1).reshape(-1, 3)
    for width in 2 ** np.arange(level, -1, -1):
        centers = ((cells + 0.5) * width + shift) * spacing @ turn
        cells = cells[np.abs(body.signed_distance(centers)) < 1.3 * width * spacing]
        if width > 1:
            cells = (2 * cells[:, None] + corners).reshape(-1, 3)
    size = int(np.abs(cells).max()) + 2
    numbers = np.ravel_multi_index(tuple((cells[:, None] + corners + size).reshape(-1, 3).T), 3 * [2 * size])
    numbers, cubes = np.unique(numbers, return_inverse=True)
    nodes = np.stack(np.unravel_index(numbers, 3 * [2 * size]), axis=1) - size
    nodes = (nodes + shift) * spacing @ turn
    # Since version 2.6.3, libigl also returns a third value.
    vertices, faces = igl.marching_cubes(body.signed_distance(nodes), nodes, cubes.reshape(-1, 8))[:2]
    return vertices, faces


def _flipped_to_delaunay(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Flip edges whose opposite angles sum to more than 180 degrees."""
    faces = faces.copy()
    for _ in range(20):
        edges, _, sides, corners = igl.edge_flaps(faces)
        # A flip replaces the edge from tip[0] to tip[1] by the edge from apex[0] to apex[1].
        apex, tip = (faces[sides, (corners + i) % 3].T for i in (0, 1))
        flipped = np.stack([np.stack([apex[s], tip[s], apex[1 - s]], axis=1) for s in (0, 1)])
        before, after = _unit_normals(vertices[faces[sides.T]]), _unit_normals(vertices[flipped])
        folds = np.einsum("sex,tex->ste", before, after).min(axis=(0, 1)) < 0.3
        arms = vertices[tip] - vertices[apex], vertices[tip[::-1]] - vertices[apex]
        opposite = np.arctan2(np.linalg.norm(np.cross(*arms), axis=2), (arms[0] * arms[1]).sum(axis=2))
        excess = opposite.sum(axis=0) - np.pi
        key, known = (np.sort(pairs, axis=1) @ [len(vertices), 1] for pairs in (apex.T, edges))
        candidates = np.flatnonzero((excess > 1e-6) & ~folds & ~np.isin(key, known))
        candidates = candidates[np.argsort(-excess[candidates], kind="stable")]
        candidates = candidates[np.sort(np.unique(key[candidates], return_index=True)[1])]
        rank = np.arange(len(candidates))
        best = np.full(len(faces), len(candidates))
        np.minimum.at(best, sides[candidates], rank[:, None])
        chosen = candidates[(best[sides[candidates]] == rank[:, None]).all(axis=1)]
        if not len(chosen):
            break
        faces[sides[chosen].T] = flipped[:, chosen]
    return faces


def _unit_normals(corners: np.ndarray) -> np.ndarray:
    normals = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-300)


def _triangulated(body: _Body, count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Make well-shaped triangles (f, 3) of the body in the rest pose, with `count` vertices (count, 3)."""
    vertices, faces = _isosurface(body, 0.05, random)
    area = igl.doublearea(vertices, faces).sum() / 2
    # Marching cubes give 1.5 vertices per spacing² of surface area. A spacing of `sqrt(1.5 area / (4 count))`
    # thus gives 4 `count` vertices. The largest spacing is 0.018.
    spacing = min(0.018, np.sqrt(1.5 * area / (4 * count)))
    for _ in range(5):
        vertices, faces = _isosurface(body, spacing, random)
        is_sphere = igl.facet_components(faces)[0] == 1 and 2 * len(vertices) - len(faces) == 4
        if is_sphere:  # topologically
            break
        spacing *= 0.8  # a coarse grid can break thin parts, and can bridge narrow gaps between parts
    else:
        raise InputError("The creature of this seed has parts that touch each other: choose another seed.")
    # Decimation collapses the shortest edges. Edge lengths include the weighted difference of the normals at
    # the two ends, so curved regions keep more vertices.
    features = np.hstack([vertices, 0.07 * body.project(vertices)[1]])
    features, faces, _, _ = igl.decimate(
        np.asfortranarray(features), np.asfortranarray(faces, dtype=np.int32), 2 * count - 4
    )
    vertices, faces = features[:, :3].copy(order="C"), faces.astype(np.int64, order="C")
    for _ in range(3):
        faces = _flipped_to_delaunay(vertices, faces)
        ends = igl.edges(faces).T
        links = coo_array((np.ones(ends.shape[1]), ends), shape=(count, count)).tocsr()
        links = links + links.T
        vertices, normals = body.project(vertices)
        pull = links @ vertices / links.sum(axis=1)[:, None] - vertices
        vertices += 0.5 * (pull - (pull * normals).sum(axis=1, keepdims=True) * normals)
    for _ in range(4):
        vertices, _ = body.project(vertices)
    return vertices, _flipped_to_delaunay(vertices, faces)


def _quadruped(body: _Body) -> None:
    """Build a fox."""
    add, limb = body.add, body.limb
    limb("hips chest", "", "0 .8 -.4 .165, 0 .8 -.08 .15, 0 .8 .26 .185", blend=0.08)
    add("0 .71 .1 .14, 0 .76 .28 .14", blend=0.08)  # deep chest
    add("0 .9 .36 .13, 0 .72 .4 .06", blend=0.06)  # ruff
    add(".12 .94 .16 .05, .16 .72 .28 .07", blend=0.06)  # shoulder blade
    limb("nape neck", "chest", "0 .88 .26 .15, 0 1.02 .42 .12, 0 1.16 .52 .11", blend=0.08)
    limb("head", "neck", "0 1.24 .53 .165, 0 1.21 .7 .125", blend=0.05)
    add("0 1.17 .7 .095, 0 1.12 .97 .045", blend=0.06)  # snout
    add("0 1.11 .66 .075, 0 1.07 .9 .032", blend=0.02)  # jaw
    add("0 1.152 .99 .036, 0 1.147 1.005 .034", blend=0.012)  # nose
    add(".1 1.19 .6 .085, .15 1.15 .58 .045", blend=0.05)  # cheek
    add(".098 1.262 .705 .054, .1 1.26 .715 .052", blend=0.006)  # eye
    add(".05 1.325 .7 .03, .12 1.318 .65 .024", blend=0.04)  # brow
    ear = ".1 1.32 .5 .095, .15 1.47 .475 .075, .175 1.6 .465 .022"
    add(ear, blend=0.04, normal=(0.35, 0.0, 1.0), thickness=0.035, joint="head")
    add(".112 1.38 .56 .05, .16 1.5 .53 .045, .175 1.56 .52 .014", blend=0.03, carved=True)
    tail = "0 .86 -.52 .05, 0 .93 -.74 .09, 0 .91 -1 .135, 0 .86 -1.22 .12, 0 .9 -1.46 .025"
    limb("tail1 tail2 tail3 tail4", "hips", tail, blend=0.05)
    foreleg = ".13 .76 .24 .11, .15 .5 .16 .07, .15 .2 .21 .048, .15 .06 .23 .055"
    limb("shoulder elbow wrist", "chest", foreleg, blend=0.06)
    limb("paw", "wrist", ".15 .055 .23 .058, .15 .05 .32 .055", blend=0.03)
    hindleg = ".11 .76 -.4 .15, .165 .5 -.26 .1, .15 .25 -.5 .045, .15 .07 -.45 .055"
    limb("hip knee hock", "hips", hindleg, blend=0.07)
    limb("foot", "hock", ".15 .055 -.45 .056, .15 .05 -.35 .055", blend=0.03)
    # Muscles on the outer side of each leg distinguish the left leg from the right leg.
    add(".17 .5 .15 .05, .175 .37 .17 .04", blend=0.04)
    add(".18 .46 -.28 .06, .18 .36 -.4 .045", blend=0.04)
    add(".12 .13 .23 .032, .1 .12 .27 .024", blend=0.015)  # dewclaw
    add(".165 .26 -.51 .034, .175 .28 -.55 .024", blend=0.015)  # heel
    for z in (0.32, -0.35):  # toes; the outer toes are longer
        add(f".106 .05 {z - 0.01} .034, .088 .035 {z + 0.03} .026", blend=0.02)
        add(f".148 .05 {z} .034, .148 .035 {z + 0.07} .027", blend=0.02)
        add(f".192 .05 {z} .036, .213 .035 {z + 0.065} .03", blend=0.02)


_QUADRUPED_POSES = {
    "stand": """
        left_shoulder -6; right_shoulder 5; left_hip 6; right_hip -5; nape 0 -6; neck 2 -8; head 4 -8 -4;
        tail1 -24 8; tail2 -14 8; tail3 0 8; tail4 10 6""",
    "walk": """
        left_shoulder -30; left_elbow 8; left_wrist 10; right_shoulder 22; right_elbow -28; right_wrist 35;
        left_hip 22; left_knee 10; left_hock -10; left_foot 20; right_hip -22; right_knee 12; chest 0 -4 4;
        nape 6 8; neck 4 8; head 6 6; tail1 -10 10; tail2 -6 12; tail3 -8 12; tail4 -10 10""",
    "look": """
        left_shoulder -40; left_elbow -55; left_wrist 75; left_paw 25; left_hip -6; right_hip 14; chest -4 8;
        nape -8 24; neck -6 24 6; head 4 26 14; tail1 35; tail2 20 -15; tail3 12 -20; tail4 10 -25""",
    "sit": """
        hips -42; chest -8; shoulder 24; elbow 18; wrist 6; hip 4 8 8; knee 28; hock -48; foot 62;
        nape 16 -10; neck 14 -14; head 20 -16 -10; tail1 20 20; tail2 10 26; tail3 0 26; tail4 0 26""",
    "bow": """
        hips 14; chest 14; shoulder -58; elbow -4; wrist 24; paw 10; hip -18; knee 4;
        nape -26; neck -16 10; head -2 14 8; tail1 30; tail2 25; tail3 10 15; tail4 0 20""",
}


def _mammal(body: _Body) -> None:
    """Build a heavy quadruped with the joints of the fox, between a dog, a cow and a lion."""
    add, limb = body.add, body.limb
    limb("hips chest", "", "0 .9 -.5 .24, 0 .88 -.05 .25, 0 .9 .36 .26", blend=0.1)
    add("0 .78 -.15 .2, 0 .76 .32 .22", blend=0.1)  # belly and breast
    add(".14 .96 .34 .12, .2 .72 .38 .11", blend=0.1)  # shoulder blade
    limb("nape neck", "chest", "0 .98 .48 .22, 0 1.08 .64 .19, 0 1.12 .76 .18", blend=0.1)
    limb("head", "neck", "0 1.15 .84 .2, 0 1.12 .98 .17", blend=0.06)
    add("0 1.08 1.02 .13, 0 1.02 1.2 .1", blend=0.06)  # snout
    add("0 1 .98 .1, 0 .94 1.14 .06", blend=0.03)  # jaw
    add(".12 1.1 .9 .1, .15 1.06 .9 .07", blend=0.05)  # cheek
    ear = ".12 1.28 .8 .08, .19 1.38 .78 .07, .22 1.45 .77 .025"
    add(ear, blend=0.04, normal=(0.35, 0.0, 1.0), thickness=0.04, joint="head")
    tail = "0 1.02 -.7 .075, 0 .95 -.88 .06, 0 .8 -1.02 .055, 0 .62 -1.1 .05, 0 .48 -1.14 .03"
    limb("tail1 tail2 tail3 tail4", "hips", tail, blend=0.06)
    foreleg = ".16 .74 .38 .15, .18 .46 .31 .09, .17 .2 .34 .06, .17 .07 .35 .065"
    limb("shoulder elbow wrist", "chest", foreleg, blend=0.08)
    limb("paw", "wrist", ".17 .06 .36 .07, .17 .055 .45 .062", blend=0.03)
    hindleg = ".14 .8 -.5 .2, .19 .5 -.4 .12, .17 .27 -.6 .06, .17 .07 -.55 .065"
    limb("hip knee hock", "hips", hindleg, blend=0.08)
    limb("foot", "hock", ".17 .06 -.54 .07, .17 .055 -.45 .062", blend=0.03)
    add(".17 .29 -.62 .045, .17 .33 -.66 .03", blend=0.03)  # heel


def _biped(body: _Body) -> None:
    """Build a goblin."""
    add, limb = body.add, body.limb
    limb("hips chest", "", "0 .8 0 .17, 0 .98 .005 .155, 0 1.16 -.01 .185", blend=0.06)
    add("0 .92 .05 .12, 0 .99 .05 .11", blend=0.08)  # belly
    add(".02 1.16 .05 .09, .1 1.14 .06 .085", blend=0.05)  # breast
    add(".03 1.22 -.02 .085, .17 1.2 -.02 .08", blend=0.05)  # shoulder
    add(".08 1.14 -.1 .06, .1 1.02 -.09 .045", blend=0.05)  # shoulder blade
    add(".075 .76 -.09 .1, .08 .74 -.08 .1", blend=0.05)  # buttock
    limb("neck", "chest", "0 1.24 -.02 .085, 0 1.38 .01 .075", blend=0.06)
    limb("head", "neck", "0 1.47 .02 .165, 0 1.57 .01 .17", blend=0.05)
    add("0 1.405 .09 .09, 0 1.385 .135 .055", blend=0.05)  # chin
    add(".08 1.445 .1 .075, .09 1.44 .1 .06", blend=0.05)  # cheek
    add("0 1.555 .165 .03, 0 1.505 .212 .042", blend=0.03)  # nose
    add(".08 1.562 .142 .046, .081 1.56 .148 .046", blend=0.008)  # eye
    add(".05 1.628 .14 .028, .125 1.628 .095 .022", blend=0.04)  # brow
    add("0 1.4 .202 .024, .045 1.41 .185 .022, .085 1.45 .172 .018", blend=0.015, carved=True)  # mouth
    ear = ".14 1.51 -.01 .075, .27 1.58 -.05 .065, .4 1.68 -.09 .022"
    add(ear, blend=0.04, normal=(0.35, 0.0, 1.0), thickness=0.035, joint="head")
    add(".21 1.55 .035 .045, .29 1.6 .01 .04, .35 1.645 -.02 .01", blend=0.03, carved=True)
    for y, z in ((1.65, 0.1), (1.68, 0.02), (1.66, -0.07), (1.6, -0.14)):  # crest
        add(f"0 {y} {z} .05, 0 {y + 0.09} {z - 0.06} .02", blend=0.03)
    arm = ".19 1.19 -.01 .078, .4 1.02 -.02 .052, .6 .86 .02 .045, .68 .795 .03 .05, .77 .71 .04 .03"
    limb("shoulder elbow wrist fingers", "chest", arm, blend=0.06)
    add(".24 1.17 0 .05, .33 1.09 .01 .045", blend=0.04)  # biceps
    add(".62 .845 .02 .055, .69 .785 .03 .078", blend=0.03, normal=(0.62, 0.78, 0.0), thickness=0.04)  # palm
    for base, middle, tip in ((-0.025, -0.053, -0.07), (0.03, 0.035, 0.04), (0.085, 0.123, 0.15)):  # fingers
        finger = f".69 .785 {base} .03, .75 .73 {middle} .026, .795 .67 {tip} .023"
        add(finger, blend=0.01, joint="fingers")
    add(".62 .83 .04 .036, .635 .82 .11 .031, .655 .8 .165 .024", blend=0.02, joint="wrist")  # thumb
    limb("hip knee", "hips", ".105 .76 0 .12, .14 .44 .02 .075, .15 .09 -.03 .05", blend=0.06)
    # The calf muscle is on the outer side of the leg, so it distinguishes the left leg from the right leg.
    add(".165 .38 -.03 .06, .16 .26 -.05 .045", blend=0.04)
    add(".13 .47 .07 .045, .13 .43 .075 .04", blend=0.03)  # kneecap
    add(".115 .13 -.03 .032, .11 .12 -.03 .03", blend=0.02)  # ankle
    limb("foot", "knee", ".15 .07 -.02 .055, .16 .055 .14 .055", blend=0.05)
    add(".15 .055 -.06 .055, .155 .055 0 .055", blend=0.03)  # heel
    add(".12 .055 .14 .048, .1 .05 .225 .042", blend=0.02)  # toes; the inner toe is the largest
    add(".175 .05 .14 .04, .182 .04 .2 .033", blend=0.02)
    add(".218 .045 .115 .034, .244 .035 .15 .027", blend=0.02)
    tail = "0 .8 -.12 .06, 0 .68 -.32 .042, 0 .62 -.55 .036, 0 .72 -.76 .034, 0 .9 -.84 .04"
    limb("tail1 tail2 tail3 tail4", "hips", tail, blend=0.05)
    add("0 .88 -.83 .05, 0 .98 -.86 .075, 0 1.07 -.86 .02", blend=0.02, joint="tail4")


_BIPED_POSES = {
    "stand": """
        shoulder 0 0 -27; elbow -14 0 -6; left_hip -6 0 2; left_knee 8; right_hip 4; neck 0 -6; head 0 -14;
        tail1 0 -10; tail2 0 -16; tail3 0 -14""",
    "walk": """
        left_shoulder 34 0 -28; left_elbow -10; right_shoulder -34 0 28; right_elbow -40; hips 0 -6;
        chest 2 12; left_hip -32; left_knee 16; left_foot 4; right_hip 24; right_knee 30; right_foot 10;
        head 2 -8 4; tail1 0 14; tail2 -10 14; tail3 0 10""",
    "wave": """
        left_shoulder 0 10 56; left_elbow -10 0 44; left_wrist 0 0 14; right_shoulder 0 0 24;
        right_elbow -35 -20; chest 0 6 -6; neck 0 8 -4; head 4 14 -12; left_hip 0 0 8; right_hip -6;
        right_knee 10; tail1 0 -20; tail2 10 -20; tail3 20""",
    "crouch": """
        hips 24; chest 14 10; hip -64 14; knee 66; foot -24; shoulder -40 0 -10; elbow -30 -30;
        neck -14 8; head -16 12 6; tail1 24 12; tail2 10 12; tail3 -10""",
}


def _dragon(body: _Body) -> None:
    """Build a dragon with four legs and two wings."""
    add, limb = body.add, body.limb
    limb("hips chest", "", "0 .56 -.4 .17, 0 .58 -.08 .185, 0 .6 .24 .18", blend=0.08)
    add("0 .5 -.18 .17, 0 .5 .1 .15", blend=0.08)  # belly
    neck = "0 .66 .3 .14, 0 .82 .48 .105, 0 1.02 .54 .088, 0 1.2 .56 .09"
    limb("nape throat neck", "chest", neck, blend=0.08)
    limb("head", "neck", "0 1.281 .558 .171, 0 1.257 .729 .128", blend=0.05)
    add("0 1.238 .729 .122, 0 1.208 .973 .085", blend=0.05)  # snout
    add("0 1.159 .655 .091, 0 1.129 .924 .061", blend=0.02)  # jaw
    add(".049 1.263 1.009 .04, .051 1.275 1.027 .037", blend=0.02)  # nostril
    add(".11 1.336 .68 .067, .112 1.336 .692 .063", blend=0.006)  # eye
    add(".049 1.397 .716 .037, .14 1.379 .637 .032", blend=0.04)  # brow
    horn = ".085 1.391 .509 .061, .122 1.525 .387 .046, .159 1.598 .216 .024"
    add(horn, blend=0.025, joint="head")
    ear = ".134 1.22 .533 .073, .244 1.244 .436 .061, .329 1.293 .35 .024"
    add(ear, blend=0.03, normal=(0.5, 0.0, 1.0), thickness=0.03, joint="head")
    tail = "0 .56 -.48 .15, 0 .48 -.74 .12, 0 .36 -1 .09, 0 .28 -1.26 .068, 0 .28 -1.52 .05, 0 .34 -1.76 .035"
    limb("tail1 tail2 tail3 tail4 tail5", "hips", tail, blend=0.08)
    barb = "0 .33 -1.7 .045, 0 .36 -1.85 .09, 0 .41 -2.05 .025"
    add(barb, blend=0.02, normal=(0.0, 1.0, -0.25), thickness=0.035, joint="tail5")
    for plate in (  # from the neck to the tail
        "0 1.23 .49 .07, 0 1.28 .388 .025",
        "0 1.05 .48 .07, 0 1.11 .36 .025",
        "0 .89 .39 .07, 0 .955 .261 .025",
        "0 .8 .22 .06, 0 .92 .16 .022",
        "0 .755 .05 .063, 0 .885 -.015 .022",
        "0 .735 -.12 .063, 0 .865 -.185 .022",
        "0 .73 -.29 .06, 0 .85 -.35 .022",
        "0 .69 -.45 .057, 0 .8 -.505 .022",
        "0 .6 -.62 .053, 0 .7 -.67 .022",
        "0 .51 -.79 .05, 0 .6 -.835 .022",
        "0 .41 -.98 .047, 0 .49 -1.02 .022",
        "0 .345 -1.17 .043, 0 .415 -1.205 .022",
        "0 .305 -1.36 .04, 0 .365 -1.39 .022",
    ):
        add(plate, blend=0.015, normal=(1.0, 0.0, 0.0), thickness=0.03)
    limb("shoulder elbow", "chest", ".16 .54 .2 .12, .22 .32 .12 .085, .22 .09 .16 .065", blend=0.06)
    limb("wrist", "elbow", ".22 .075 .17 .065, .22 .065 .26 .06", blend=0.05)
    limb("hip knee", "hips", ".15 .52 -.36 .155, .24 .32 -.26 .115, .22 .09 -.42 .065", blend=0.06)
    limb("foot", "knee", ".22 .075 -.4 .065, .22 .065 -.29 .065", blend=0.05)
    for z in (0.26, -0.3):  # claws, and a spur on the outer side of the foot; the inner claw turns inward
        add(f".17 .06 {z - 0.05} .04, .12 .035 {z - 0.01} .026", blend=0.02)
        add(f".2 .055 {z} .042, .187 .03 {z + 0.085} .026", blend=0.02)
        add(f".265 .055 {z} .042, .29 .03 {z + 0.07} .026", blend=0.02)
        add(f".26 .13 {z - 0.11} .04, .31 .17 {z - 0.14} .024", blend=0.02)
    limb("wing hand", "chest", ".12 .74 .1 .07, .34 .94 .16 .055, .62 1.17 .14 .045", blend=0.04)
    add(".62 1.17 .14 .042, .81 1.32 .07 .034, .93 1.42 0 .024", blend=0.03, joint="hand")  # fingers
    add(".62 1.17 .14 .042, .76 1.26 -.12 .034, .86 1.33 -.32 .024", blend=0.03, joint="hand")
    add(".62 1.17 .14 .042, .64 1.15 -.22 .034, .65 1.13 -.48 .024", blend=0.03, joint="hand")
    add(".34 .94 .16 .045, .37 .94 -.13 .034, .38 .92 -.37 .024", blend=0.03, joint="wing")
    for joint, web in (
        ("hand", ".65 1.19 .1 .07, .83 1.33 -.1 .15"),
        ("hand", ".62 1.17 .06 .09, .74 1.23 -.3 .17"),
        ("hand", ".47 1.04 .07 .17, .5 1.03 -.27 .19"),
        ("wing", ".28 .88 .08 .12, .32 .89 -.21 .13"),
    ):
        add(web, blend=0.03, normal=(-0.65, 0.76, -0.078), thickness=0.025, joint=joint)


_DRAGON_POSES = {
    "stand": """
        left_shoulder -6; right_shoulder 6; left_hip 6; right_hip -4; nape 10 -6; throat 4 -8; neck 0 -8;
        head -2 -8 -4; wing 0 12 2; hand 0 20 -8;
        tail1 -4 8; tail2 0 12; tail3 0 12; tail4 0 12; tail5 0 10""",
    "prowl": """
        left_shoulder -28; left_elbow 10; right_shoulder 14; right_elbow -16; left_hip 18; right_hip -12;
        nape 14 10; throat 10 10; neck 6 8; head -10 10; wing 0 6 -6; hand 0 10 -12;
        tail1 0 14; tail2 0 16; tail3 0 12; tail4 0 -14; tail5 0 -14""",
    "flight": """
        hips -8; shoulder 24; elbow -14; hip 34; knee 10; foot 30; nape 20 -6; throat 12 -8; neck -4 -6;
        head -4 -8; wing 0 -10 8; hand 0 -8 12; tail1 -4 -6; tail2 4 -8; tail3 8; tail4 8 10; tail5 8 10""",
    "roar": """
        hips -30; shoulder -30 0 10; elbow -20; hip 24; knee -10; nape 4 -12; throat 10 -14; neck 10 -12;
        head -20 -8 6; wing 0 6 16; hand 0 14 12;
        tail1 24 10; tail2 10 16; tail3 6 18; tail4 0 18; tail5 0 12""",
    "look": """
        left_shoulder -10; right_shoulder 8; left_hip 8; right_hip -6; chest 0 8; nape 0 22; throat 4 26;
        neck 6 26; head 8 16 10; wing 0 -6 -4; hand 0 10 -16;
        tail1 0 -20; tail2 0 -24; tail3 0 -26; tail4 0 -24; tail5 0 -20""",
}

_KINDS: dict[str, tuple[Callable[[_Body], None], dict[str, str]]] = {
    "quadruped": (_quadruped, _QUADRUPED_POSES),
    "biped": (_biped, _BIPED_POSES),
    "dragon": (_dragon, _DRAGON_POSES),
    "mammal": (_mammal, {pose: _QUADRUPED_POSES[pose] for pose in ("stand", "walk", "look")}),
}

CREATURES: Mapping[str, tuple[str, ...]] = {kind: ("rest", *poses) for kind, (_, poses) in _KINDS.items()}
"""A dictionary from each kind of creature to the names of its poses."""


def creature(kind: str = "quadruped", *, vertices: int = 5000, pose: str = "rest", seed: int = 0) -> Mesh:
    """Make the mesh of a creature.

    The mesh is closed and has no handles. The triangles are well shaped and oriented outward. For a given
    kind, number of vertices and seed, every pose has the same triangles, so vertex i is always the same point
    of the body. In the rest pose, the body is mirror symmetric in x, but its triangulation is not symmetric.
    The mesh is about 1.5 units high. The x axis points to the creature's left, the y axis up and the z axis
    forward.

    **Arguments:**

    - `kind`: `"quadruped"` (a fox), `"biped"` (a goblin), `"dragon"`, or `"mammal"` (a heavy quadruped
      between a dog, a cow and a lion).
    - `vertices`: the number of vertices, at least 500.
    - `pose`: one of the poses that `CREATURES` lists for this kind.
    - `seed`: an integer of at least 0, which determines the proportions, the triangulation, and the small
      random changes of the pose.

    **Raises:** `InputError` for an unknown kind or pose, fewer than 500 vertices, a negative seed, or a seed
    whose body intersects itself. No seed below 250 makes a quadruped, a biped or a dragon that intersects
    itself.
    """
    _check(kind, vertices, seed)
    if pose not in CREATURES[kind]:
        raise InputError(f"Pose {pose!r} of a {kind} is unknown: choose one of {', '.join(CREATURES[kind])}.")
    body = _grown(kind, seed)
    rest, faces = _triangulated(body, vertices, _random(seed, "source"))
    return _posed(body, rest, faces, kind, pose, seed)


def creature_pair(kind: str = "quadruped", *, vertices: int = 5000, seed: int = 0) -> CreaturePair:
    """Make two meshes of one synthetic creature in two poses, with exact ground truth.

    The two shapes are nearly isometric and are triangulated independently. The source is in the pose
    `"stand"`. The target is the same individual in another, randomly chosen pose, with 1 to 5 % fewer
    vertices. To compute the ground truth, the source vertices are projected onto the target's triangles in
    the common rest pose. This projection is the only source of errors in the ground truth.

    **Arguments:**

    - `kind`: `"quadruped"`, `"biped"`, `"dragon"` or `"mammal"`; see `jaxsmw.creature.creature`.
    - `vertices`: the number m of source vertices, at least 500. SHOT needs about 700.
    - `seed`: an integer of at least 0, which determines the individual and the pose of the target.

    **Raises:** the errors of `jaxsmw.creature.creature`.
    """
    _check(kind, vertices, seed)
    random = _random(seed, "pair")
    source_pose, *others = _KINDS[kind][1]
    target_pose = str(random.choice(others))
    body = _grown(kind, seed)
    rest, faces = _triangulated(body, vertices, _random(seed, "source"))
    target_count = round(vertices * random.uniform(0.95, 0.99))
    target_rest, target_faces = _triangulated(body, target_count, _random(seed, "target"))
    _, nearest, points = igl.point_mesh_squared_distance(rest, target_rest, target_faces)
    corners = np.ascontiguousarray(target_rest[target_faces[nearest]].transpose(1, 0, 2))
    weights = np.maximum(igl.barycentric_coordinates(points, *corners), 0)
    return CreaturePair(
        source=_posed(body, rest, faces, kind, source_pose, seed),
        target=_posed(body, target_rest, target_faces, kind, target_pose, seed),
        truth=SurfacePoints(nearest.astype(np.int64), weights / weights.sum(axis=1, keepdims=True)),
    )


def _check(kind: str, vertices: int, seed: int) -> None:
    if kind not in CREATURES:
        raise InputError(f"Creature {kind!r} is unknown: choose one of {', '.join(CREATURES)}.")
    for name, value, least in (("number of vertices", vertices, _MINIMUM_VERTICES), ("seed", seed, 0)):
        if value < least:
            raise InputError(f"The {name} of a creature is {value}: choose {least} or more.")


def _random(seed: int, purpose: str) -> np.random.Generator:
    return np.random.default_rng([seed, *purpose.encode()])


def _grown(kind: str, seed: int) -> _Body:
    body = _Body(_random(seed, "body"))
    _KINDS[kind][0](body)
    return body


def _posed(body: _Body, rest: np.ndarray, faces: np.ndarray, kind: str, pose: str, seed: int) -> Mesh:
    name = f"{kind} {seed} ({pose})"
    if pose == "rest":
        return Mesh(rest, faces, name)
    return Mesh(body.posed(rest, body.angles(_KINDS[kind][1][pose], _random(seed, pose))), faces, name)
