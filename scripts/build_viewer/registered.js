// The source, blended between its own shape and its registered shape, drawn over the target.

import { BufferAttribute, BufferGeometry, DoubleSide, Mesh, MeshStandardMaterial } from "three";
import { decode } from "./body.js";

const TARGET_OPACITY = 0.3;

export function startRegistered({ bodies: { x, y }, data, draw }) {
  const byId = (id) => document.getElementById(id);
  if (!data.registered) return;
  const registered = decode(data.registered, Float32Array);
  const overlay = makeOverlay(x);
  y.scene.add(overlay);

  const blend = () => {
    const share = byId("blend").valueAsNumber / 100;
    const positions = overlay.geometry.attributes.position;
    for (let i = 0; i < registered.length; i++) {
      positions.array[i] = (1 - share) * x.positions[i] + share * registered[i];
    }
    positions.needsUpdate = true;
    overlay.geometry.computeVertexNormals();
    byId("blend").setAttribute("aria-valuetext", `${Math.round(100 * share)} % registered`);
    draw();
  };
  const show = () => {
    const on = byId("overlay").checked;
    overlay.visible = on;
    byId("blend").disabled = !on;
    Object.assign(y.surface.material, { transparent: on, opacity: on ? TARGET_OPACITY : 1, depthWrite: !on });
    y.surface.material.needsUpdate = true;
    draw();
  };
  byId("blend").addEventListener("input", blend);
  byId("overlay").addEventListener("change", show);
  byId("registered").hidden = false;
  blend();
  show();
}

/** A copy of the source's surface, with the same colours. */
function makeOverlay({ positions, surface }) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(positions.slice(), 3));
  geometry.setAttribute("color", surface.geometry.attributes.color);
  geometry.setIndex(surface.geometry.index);
  const overlay = new Mesh(geometry, new MeshStandardMaterial({ vertexColors: true, side: DoubleSide, roughness: 0.62 }));
  overlay.frustumCulled = false; // the positions change
  return overlay;
}
