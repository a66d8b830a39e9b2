// The small pictures of all shapes, drawn by one renderer that is removed afterwards.

import { Body } from "./body.js";
import { rove } from "./input.js";

const SIZE = 132; // pixels
const MANY = 24; // narrow screens show more pictures than this in two rows
const MEASURED = 12; // the most shapes that determine the common distance of the camera
const PER_FRAME = 3;

/** Makes one button per shape. Returns the canvases and a function that marks the open shapes. */
export function makeGallery(data, open) {
  const gallery = document.getElementById("gallery");
  gallery.parentElement.classList.toggle("many", data.names.length > MANY);
  const element = (tag, properties = {}) => Object.assign(document.createElement(tag), properties);
  const buttons = data.names.map((name, index) => {
    const button = element("button", { type: "button", className: "thumb", title: name });
    const canvas = element("canvas", { width: 2 * SIZE, height: 2 * SIZE });
    button.append(canvas, element("span", { textContent: name }), element("div", { className: "marks" }));
    if (index === data.template) button.append(element("small", { textContent: "template" }));
    return button;
  });
  gallery.append(...buttons);
  rove(buttons, (index) => open(index));
  return {
    list: buttons.map((button) => button.querySelector("canvas")),
    mark: (marks) => {
      buttons.forEach((button, index) => {
        button.classList.toggle("open", marks[index].length > 0);
        button.setAttribute("aria-pressed", marks[index].length > 0);
        const badge = (side) => element("i", { className: `badge ${side}`, textContent: side.toUpperCase() });
        button.querySelector(".marks").replaceChildren(...marks[index].map(badge));
      });
    },
  };
}

/** Draws a few pictures per frame, and calls `done` with the index and the canvas of each picture. */
export function drawThumbnails({ canvases, shape, colors, faces, direction }, done) {
  const body = new Body(document.createElement("canvas"), shape(0), faces);
  body.paint(colors);
  body.resize(SIZE, SIZE);
  let distance = 0;
  const step = Math.ceil(canvases.length / MEASURED);
  for (let index = 0; index < canvases.length; index += step) {
    body.move(shape(index));
    distance = Math.max(distance, body.distanceToFit(direction));
  }
  let next = 0;
  const drawSome = () => {
    for (let i = 0; i < PER_FRAME && next < canvases.length; i++, next++) {
      body.move(shape(next));
      body.lookFrom(direction.clone().setLength(Math.max(distance, body.distanceToFit(direction))));
      body.render();
      const context = canvases[next].getContext("2d");
      context.drawImage(body.canvas, 0, 0, canvases[next].width, canvases[next].height);
      done(next, canvases[next]);
    }
    if (next < canvases.length) requestAnimationFrame(drawSome);
    else {
      body.renderer.dispose();
      body.renderer.forceContextLoss(); // browsers limit the number of contexts
    }
  };
  requestAnimationFrame(drawSome);
}
