// Two plots of all shapes, in SVG: the matched pairs as a graph, and the scores of two modes.

import { rove } from "./rove.js";

const NAMED = 30; // the most shapes whose names are written next to the nodes
const NAMED_SCORES = 12; // the most shapes whose names are written next to their scores
const PICTURED = 40; // the most shapes that the graph shows as pictures
const LONGEST_NAME = 14;
const SEPARATIONS = 200; // rounds that move overlapping nodes apart
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

export function startPlots({ data, open, compare }) {
  const { names, edges, model } = data;
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

  /** Adds one node per shape at these places. `radius` is the size of the nodes, in pixels. */
  function addNodes(picture, places, radius, { withPictures, withNames, describe }) {
    const nodes = names.map((name, index) => {
      const [x, y] = places[index];
      const node = svg("g", { class: "node", role: "button", "data-shape": index, "aria-label": name, transform: `translate(${x} ${y})` });
      if (withPictures) {
        node.append(svg("circle", { class: "disc", r: radius }));
        if (pictures[index]) addPicture(node, index, radius);
      } else node.append(svg("circle", { class: "dot", r: radius }));
      if (withNames) node.append(svg("text", { y: radius + 13 }, short(name)));
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

  /** Moves overlapping nodes apart, and keeps all nodes in the box. */
  function separate(places, least, [left, top, right, bottom]) {
    for (let round = 0; round < SEPARATIONS; round++) {
      let moved = false;
      for (let i = 0; i < places.length; i++) {
        for (let j = 0; j < i; j++) {
          let [x, y] = [places[i][0] - places[j][0], places[i][1] - places[j][1]];
          const distance = Math.hypot(x, y);
          if (distance >= least) continue;
          moved = true;
          // Nodes at the same place part in different directions.
          if (distance < 1e-6) [x, y] = [Math.cos(GOLDEN * i), Math.sin(GOLDEN * i)];
          else [x, y] = [x / distance, y / distance];
          const push = 0.5 * (least - distance);
          places[i][0] += push * x;
          places[i][1] += push * y;
          places[j][0] -= push * x;
          places[j][1] -= push * y;
        }
      }
      for (const place of places) {
        place[0] = Math.max(left, Math.min(right, place[0]));
        place[1] = Math.max(top, Math.min(bottom, place[1]));
      }
      if (!moved) break;
    }
  }

  function drawGraph(width) {
    const narrow = width < 480;
    const height = Math.round(Math.max(280, Math.min(0.78 * width, 560)));
    const withPictures = names.length <= PICTURED;
    const radius = (narrow ? 0.75 : 1) * (names.length <= 16 ? 30 : withPictures ? 22 : 7);
    const margin = radius + (names.length <= NAMED ? 20 : 6);
    const [lowX, highX] = [0, 1].map((end) => Math[end ? "max" : "min"](...data.layout.map(([x]) => x)));
    const [lowY, highY] = [0, 1].map((end) => Math[end ? "max" : "min"](...data.layout.map(([, y]) => y)));
    const factor = Math.min((width - 2 * margin) / (highX - lowX || 1e-9), (height - 2 * margin) / (highY - lowY || 1e-9), 1e9);
    const places = data.layout.map(([x, y]) => [
      width / 2 + factor * (x - (lowX + highX) / 2),
      height / 2 - factor * (y - (lowY + highY) / 2),
    ]);
    const gap = names.length <= NAMED ? 22 : 6; // room for names
    separate(places, 2 * radius + gap, [margin, radius + 6, width - margin, height - margin]);

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
    const nodes = addNodes(picture, places, radius, { withPictures, withNames: withPictures && names.length <= NAMED, describe: kind });
    return { picture, nodes, pictureRadius: withPictures ? radius : 0 };
  }

  // ---- The scores

  function drawScores(width) {
    const height = Math.round(Math.max(280, Math.min(0.78 * width, 560)));
    const [across, up] = [byId("across").value, byId("upward").value].map(Number);
    const of = (index) => [model.scores[index][across], model.scores[index][up] ?? 0];
    const limit = 1.12 * Math.max(3, ...names.flatMap((_, index) => of(index).map(Math.abs)));
    const [left, bottom, edge] = [14, 22, 8];
    const toX = (score) => left + ((score + limit) / (2 * limit)) * (width - left - edge);
    const toY = (score) => edge + ((limit - score) / (2 * limit)) * (height - bottom - edge);
    const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": "Scores of the shapes" });
    for (let tick = -Math.floor(limit); tick <= limit; tick++) {
      const opacity = tick ? 0.5 : 1;
      picture.append(
        svg("line", { class: "axis", opacity, x1: toX(tick), x2: toX(tick), y1: edge, y2: height - bottom }),
        svg("line", { class: "axis", opacity, x1: left, x2: width - edge, y1: toY(tick), y2: toY(tick) }),
      );
      const label = `${tick}`.replace("-", "−");
      picture.append(svg("text", { class: "tick", x: toX(tick), y: height - 7 }, label));
      if (tick) picture.append(svg("text", { class: "tick", x: 6, y: toY(tick) + 4 }, label));
    }
    const places = names.map((_, index) => of(index).map((score, axis) => (axis ? toY(score) : toX(score))));
    const signed = (score) => score.toFixed(1).replace("-", "−");
    const describe = (index) => {
      const words = `${signed(of(index)[0])} σ across, ${signed(of(index)[1])} σ up`;
      return index === data.template ? `the template; ${words}` : words;
    };
    const nodes = addNodes(picture, places, names.length > 40 ? 5 : 7, { withPictures: false, withNames: names.length <= NAMED_SCORES, describe });
    const cross = svg("path", { class: "cursor", d: "M-8 0H8M0 -8V8" });
    picture.append(cross);
    const place = () => {
      if (cursor) cross.setAttribute("transform", `translate(${toX(cursor[across])} ${toY(cursor[up] ?? 0)})`);
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
