// Numbered markers on one body: discs that keep their size on the screen, and are faint where the body hides them.

import { CanvasTexture, LinearFilter, Sprite, SpriteMaterial, SRGBColorSpace, Vector3 } from "three";

const PIXELS = { marker: 11, selected: 14 }; // radius on the screen, in CSS pixels
const FAINT = 0.35;

const pictures = new Map();

/** The picture of a marker: a filled disc for a landmark, and a hollow disc for a proposal. */
function picture({ text, color, hollow, selected }) {
  const key = `${text} ${color} ${hollow} ${selected}`;
  if (!pictures.has(key)) pictures.set(key, drawPicture(text, color, hollow, selected));
  return pictures.get(key);
}

function drawPicture(text, color, hollow, selected) {
  const canvas = document.createElement("canvas");
  // As many pixels as on the screen, so that numbers are sharp.
  const width = Math.round(2 * (selected ? PIXELS.selected : PIXELS.marker) * Math.min(window.devicePixelRatio, 2));
  canvas.width = canvas.height = width;
  const pen = canvas.getContext("2d"), center = width / 2;
  const disc = (radius, style) => {
    pen.fillStyle = style;
    pen.beginPath();
    pen.arc(center, center, radius, 0, 2 * Math.PI);
    pen.fill();
  };
  disc(0.5 * width, selected ? "#000000" : "#00000066");
  disc(0.46 * width, "#ffffff");
  if (hollow) {
    pen.strokeStyle = color;
    pen.lineWidth = 0.09 * width;
    pen.setLineDash([0.16 * width, 0.1 * width]);
    pen.beginPath();
    pen.arc(center, center, 0.38 * width, 0, 2 * Math.PI);
    pen.stroke();
  } else disc(0.4 * width, color);
  pen.fillStyle = hollow ? color : "#ffffff";
  pen.font = `bold ${(text.length > 2 ? 0.34 : 0.46) * width}px system-ui, sans-serif`;
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.fillText(text, center, 1.04 * center);
  const texture = new CanvasTexture(canvas);
  Object.assign(texture, { minFilter: LinearFilter, generateMipmaps: false });
  texture.colorSpace = SRGBColorSpace;
  return texture;
}

export class Markers {
  constructor(body) {
    this.body = body;
    this.shown = [];
    this.sprites = [];
    body.overlays.push(this);
  }

  /** Shows these markers and no others: { position, text, color, hollow, selected, item }. */
  show(markers) {
    for (const sprite of this.sprites) {
      this.body.scene.remove(sprite);
      sprite.material.dispose();
    }
    this.shown = markers;
    this.sprites = markers.flatMap((marker) =>
      [1, FAINT].map((opacity) => {
        const map = picture(marker);
        const material = new SpriteMaterial({ map, opacity, depthTest: opacity === 1, depthWrite: false });
        const sprite = new Sprite(material);
        sprite.renderOrder = marker.selected ? 2 : 1;
        this.body.scene.add(sprite);
        return sprite;
      }),
    );
    this.body.canvas.dataset.markers = markers.length;
  }

  /** Places the sprites for the current camera, a little in front of the surface. */
  place() {
    this.shown.forEach(({ position, selected }, i) => {
      const center = new Vector3(...position);
      const radius = (selected ? PIXELS.selected : PIXELS.marker) * this.body.pixelAt(center);
      center.addScaledVector(this.body.camera.position.clone().sub(center).normalize(), radius);
      for (const sprite of this.sprites.slice(2 * i, 2 * i + 2)) {
        sprite.position.copy(center);
        sprite.scale.set(2 * radius, 2 * radius, 1);
      }
    });
  }

  /** The visible marker that is nearest to the pointer and at most `reach` pixels away, or null. */
  at(event, reach) {
    let best = null;
    for (const marker of this.shown) {
      const { x, y } = this.body.projectPoint(marker.position);
      const distance = Math.hypot(event.clientX - x, event.clientY - y);
      if (distance <= reach && (!best || distance < best.distance)) best = { marker, distance };
    }
    return best && !this.body.hides(best.marker.position) ? best.marker : null;
  }
}
