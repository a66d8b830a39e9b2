// Two plots of all shapes, in SVG: the matched pairs as a graph, and the scores of two modes.

import { rove } from "./input.js";

const CROWDED = 0.5; // if nodes and names need more than this share of the graph, the names are left out
const NAMED_SCORES = 12; // the most shapes whose names are written next to their scores
const PICTURED = 40; // the most shapes that the graph shows as pictures
const LONGEST_NAME = 14;
const SEPARATIONS = 1000; // rounds that move overlapping nodes apart
const NAME_HEIGHT = 16; // pixels, from a node to the lower end of its name
const GOLDEN = Math.PI * (3 - Math.sqrt(5));

const byId = (id) => document.getElementById(id);
// Names often differ at their ends alone, so long names lose their middle.
const short = (name) => (name.length > LONGEST_NAME ? `${name.slice(0, 5)}…${name.slice(6 - LONGEST_NAME)}` : name);
const percent = (share) => `${(100 * share).toFixed(share < 0.1 ? 1 : 0)} %`;

function svg(tag, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

/** Returns the widths of short names next to the nodes, in pixels. */
function measure(names) {
  const pen = document.createElement("canvas").getContext("2d");
  const rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
  pen.font = `${0.72 * rem}px system-ui, sans-serif`; // as in collection.html
  return names.map((name) => pen.measureText(short(name)).width);
}

export function startPlots({ data, open, compare }) {
  const { names, edges, model } = data;
  const lengths = measure(names);
  const pictures = names.map(() => null); // data URLs
  let marks = names.map(() => false);
  let cursor = null; // the scores of the sliders
  const plots = [];

  // ---- The tooltip

  const tip = byId("tip");
  const say = (event, title, text, picture) => {
    tip.querySelector("b").textContent = title;
    tip.querySelector("span").textContent = text;
    const image = tip.querySelector("img");
    image.hidden = !picture;
    if (picture) image.src = picture;
    tip.hidden = false;
    const box = event.target.getBoundingClientRect();
    const [x, y] = "clientX" in event ? [event.clientX, event.clientY] : [box.left + box.width / 2, box.bottom];
    const { offsetWidth: width, offsetHeight: height } = tip;
    tip.style.left = `${Math.max(8, Math.min(innerWidth - width - 8, x + 14))}px`;
    tip.style.top = `${y + 18 + height > innerHeight ? y - height - 12 : y + 18}px`;
  };
  const hush = () => (tip.hidden = true);
  const explain = (element, words) => {
    const show = (event) => say(event, ...words());
    for (const kind of ["pointerenter", "pointermove", "focus"]) element.addEventListener(kind, show);
    for (const kind of ["pointerleave", "blur"]) element.addEventListener(kind, hush);
  };

  // ---- Nodes of both plots

  /** Draws the small picture of a shape over the disc of its node, below its name. */
  function addPicture(node, index, radius) {
    const size = 1.8 * radius;
    const image = svg("image", { href: pictures[index], x: -size / 2, y: -size / 2, width: size, height: size });
    node.querySelector(".disc").after(image);
  }

  /** Adds one node per shape at these places. `radius` is the size of the nodes, in pixels. The tooltip always shows
   * the name of a node, and `named` says which nodes show it permanently. */
  function addNodes(picture, places, radius, { withPictures, named, describe }) {
    const nodes = names.map((name, index) => {
      const [x, y] = places[index];
      const node = svg("g", { class: "node", role: "button", "data-shape": index, "aria-label": name, transform: `translate(${x} ${y})` });
      if (withPictures) {
        node.append(svg("circle", { class: "disc", r: radius }));
        if (pictures[index]) addPicture(node, index, radius);
      } else node.append(svg("circle", { class: "dot", r: radius }));
      if (named[index]) node.append(svg("text", { y: radius + 13 }, short(name)));
      node.classList.toggle("template", index === data.template);
      explain(node, () => [name, describe(index), pictures[index]]);
      return node;
    });
    picture.append(svg("g", {}, ...nodes));
    rove(nodes, open);
    return nodes;
  }

  const kind = (index) => (index === data.template ? "the template" : "");

  // ---- The graph of matched pairs

  /** Moves overlapping nodes with their names apart, and keeps them in the picture. A node with its name is a box of
   * the given width, from `above` to `below` pixels around its place. */
  function separate(places, widths, [above, below], width, height) {
    const gap = 6;
    for (let round = 0; round < SEPARATIONS; round++) {
      let moved = false;
      for (let i = 0; i < places.length; i++) {
        for (let j = 0; j < i; j++) {
          const offset = [places[i][0] - places[j][0], places[i][1] - places[j][1]];
          const overlap = [(widths[i] + widths[j]) / 2 + gap - Math.abs(offset[0]), above + below + gap - Math.abs(offset[1])];
          if (Math.min(...overlap) <= 0.1) continue;
          moved = true;
          // Nodes at the same place part in different directions.
          if (Math.hypot(...offset) < 1e-6) offset.splice(0, 2, Math.cos(GOLDEN * i), Math.sin(GOLDEN * i));
          const axis = Number(overlap[1] < overlap[0]);
          const push = (Math.sign(offset[axis]) || 1) * 0.5 * overlap[axis];
          places[i][axis] += push;
          places[j][axis] -= push;
        }
      }
      places.forEach((place, i) => {
        place[0] = Math.max(widths[i] / 2, Math.min(width - widths[i] / 2, place[0]));
        place[1] = Math.max(above, Math.min(height - below, place[1]));
      });
      if (!moved) break;
    }
  }

  function drawGraph(width) {
    const narrow = width < 480;
    const height = Math.round(Math.max(280, Math.min(0.78 * width, 560)));
    const withPictures = names.length <= PICTURED;
    const radius = (narrow ? 0.75 : 1) * (names.length <= 16 ? 30 : withPictures ? 22 : 7);
    const widest = lengths.map((length) => Math.max(length, 2 * radius));
    const space = widest.reduce((sum, length) => sum + length * (2 * radius + NAME_HEIGHT), 0);
    const withNames = withPictures && space <= CROWDED * width * height;
    const margin = radius + (withNames ? NAME_HEIGHT : 0) + 4; // the outline of an open node is thick
    const [lowX, highX] = [0, 1].map((end) => Math[end ? "max" : "min"](...data.layout.map(([x]) => x)));
    const [lowY, highY] = [0, 1].map((end) => Math[end ? "max" : "min"](...data.layout.map(([, y]) => y)));
    const factor = Math.min((width - 2 * margin) / (highX - lowX || 1e-9), (height - 2 * margin) / (highY - lowY || 1e-9), 1e9);
    const places = data.layout.map(([x, y]) => [
      width / 2 + factor * (x - (lowX + highX) / 2),
      height / 2 - factor * (y - (lowY + highY) / 2),
    ]);
    separate(places, withNames ? widest : names.map(() => 2 * radius), [radius + 4, margin], width, height);

    const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": "Graph of matched pairs" });
    const lines = edges.map((edge, index) => {
      const [[x1, y1], [x2, y2]] = [places[edge.source], places[edge.target]];
      const line = { x1, y1, x2, y2 };
      const reach = svg("line", { ...line, class: "reach" });
      const error = edge.error === null ? "The expected error is unknown." : `Expected error ${edge.error.toFixed(1)} ‰ of √area.`;
      const doubt = edge.doubtful ? " Doubtful." : "";
      explain(reach, () => [`${names[edge.source]} → ${names[edge.target]}`, `${error}${doubt}${edge.note ? ` ${edge.note}` : ""}`, null]);
      reach.addEventListener("click", () => compare(index));
      return { doubtful: edge.doubtful, elements: [reach, svg("line", { ...line, class: edge.doubtful ? "edge doubtful" : "edge" })] };
    });
    lines.sort((a, b) => a.doubtful - b.doubtful); // doubtful lines are drawn over the other lines
    picture.append(...lines.flatMap(({ elements }) => elements));
    const nodes = addNodes(picture, places, radius, { withPictures, named: names.map(() => withNames), describe: kind });
    return { picture, nodes, pictureRadius: withPictures ? radius : 0 };
  }

  // ---- The scores

  function drawScores(width) {
    // One mode alone has no direction up.
    const flat = model.modes.length === 1;
    const height = flat ? 120 : Math.round(Math.max(280, Math.min(0.78 * width, 560)));
    const [across, up] = [byId("across").value, byId("upward").value].map(Number);
    const of = (index) => [model.scores[index][across], flat ? 0 : model.scores[index][up]];
    const limit = 1.12 * Math.max(3, ...names.flatMap((_, index) => of(index).map(Math.abs)));
    const [left, bottom, edge] = [14, 22, 8];
    const toX = (score) => left + ((score + limit) / (2 * limit)) * (width - left - edge);
    const toY = (score) => edge + ((limit - score) / (2 * limit)) * (height - bottom - edge);
    /** Returns which names have enough room: they are inside the picture, and cover no node and no other name. */
    const roomFor = (places, radius) => {
      const boxes = places.map(([x, y]) => [x - radius, x + radius, y - radius, y + radius]);
      return places.map(([x, y], index) => {
        const half = lengths[index] / 2;
        const box = [x - half, x + half, y + radius, y + radius + NAME_HEIGHT];
        const covers = (other) => box[0] < other[1] && other[0] < box[1] && box[2] < other[3] && other[2] < box[3];
        if (box[0] < 0 || box[1] > width || boxes.some(covers)) return false;
        boxes.push(box);
        return true;
      });
    };
    const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": "Scores of the shapes" });
    for (let tick = -Math.floor(limit); tick <= limit; tick++) {
      const opacity = tick ? 0.5 : 1;
      picture.append(
        svg("line", { class: "axis", opacity, x1: toX(tick), x2: toX(tick), y1: edge, y2: height - bottom }),
      );
      if (!flat || !tick) picture.append(svg("line", { class: "axis", opacity, x1: left, x2: width - edge, y1: toY(tick), y2: toY(tick) }));
      const label = `${tick}`.replace("-", "−");
      picture.append(svg("text", { class: "tick", x: toX(tick), y: height - 7 }, label));
      if (tick && !flat) picture.append(svg("text", { class: "tick", x: 6, y: toY(tick) + 4 }, label));
    }
    const places = names.map((_, index) => of(index).map((score, axis) => (axis ? toY(score) : toX(score))));
    const signed = (score) => score.toFixed(1).replace("-", "−");
    const describe = (index) => {
      const words = `${signed(of(index)[0])} σ across${flat ? "" : `, ${signed(of(index)[1])} σ up`}`;
      return index === data.template ? `the template; ${words}` : words;
    };
    const radius = names.length > 40 ? 5 : 7;
    const named = names.length <= NAMED_SCORES ? roomFor(places, radius) : [];
    const nodes = addNodes(picture, places, radius, { withPictures: false, named, describe });
    const cross = svg("path", { class: "cursor", d: "M-8 0H8M0 -8V8" });
    picture.append(cross);
    const place = () => {
      if (cursor) cross.setAttribute("transform", `translate(${toX(cursor[across])} ${toY(flat ? 0 : cursor[up])})`);
      cross.setAttribute("visibility", cursor ? "visible" : "hidden");
    };
    place();
    return { picture, nodes, place };
  }

  // ---- Drawing

  /** Marks the nodes of the shapes that are shown, and draws these nodes over the other nodes. */
  function markNodes(nodes) {
    nodes.forEach((node, index) => node.classList.toggle("open", marks[index]));
    nodes[0].parentNode.prepend(...nodes.filter((_, index) => !marks[index]));
  }

  function start(id, make) {
    const plot = { container: byId(id), make, width: 0, drawn: null };
    plot.draw = () => {
      if (!plot.width) return;
      hush();
      plot.drawn = make(plot.width);
      plot.container.replaceChildren(plot.drawn.picture);
      markNodes(plot.drawn.nodes);
    };
    new ResizeObserver(() => {
      const width = Math.round(plot.container.clientWidth);
      if (width === plot.width) return;
      plot.width = width;
      plot.draw();
    }).observe(plot.container);
    plots.push(plot);
    return plot;
  }

  const graph = names.length > 1 ? start("graph", drawGraph) : null;
  byId("pairs").hidden = !graph;
  let scores = null;
  if (model && model.modes.length) {
    byId("plot").hidden = false;
    byId("upward").parentElement.hidden = model.modes.length === 1;
    for (const [id, chosen] of [["across", 0], ["upward", Math.min(1, model.modes.length - 1)]]) {
      byId(id).append(...model.shares.map((share, k) => new Option(`Mode ${k + 1} (${percent(share)})`, k, false, k === chosen)));
      byId(id).addEventListener("change", () => scores.draw());
    }
    scores = start("scores", drawScores);
  }

  return {
    mark: (shown) => {
      marks = shown;
      for (const { drawn } of plots) if (drawn) markNodes(drawn.nodes);
    },
    moveCursor: (values) => {
      cursor = values.slice();
      scores?.drawn?.place();
    },
    /** Shows the picture of a shape in the graph and in tooltips. */
    showPicture: (index, canvas) => {
      pictures[index] = canvas.toDataURL("image/png");
      const { nodes, pictureRadius } = graph?.drawn ?? {};
      if (pictureRadius) addPicture(nodes[index], index, pictureRadius);
    },
  };
}
