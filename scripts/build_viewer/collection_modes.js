// The mean shape, deformed along its modes by sliders.

import { Body, moveByKey } from "./body.js";

const LIMIT = 3; // standard deviations
const PERIOD = 5000; // milliseconds of one oscillation

const byId = (id) => document.getElementById(id);

export function startDeformation({ data, colors, faces, direction, readPositions, centered, onChange }) {
  const { model } = data;
  const mean = centered(readPositions(model.mean), model.mean);
  const modes = model.modes.map(readPositions);
  const scores = modes.map(() => 0);
  const positions = mean.slice();
  byId("deform").hidden = false;
  const body = new Body(byId("canvas-mean"), mean.slice(), faces);
  body.paint(colors);

  let frame = 0;
  const draw = () => {
    frame ||= requestAnimationFrame(() => {
      frame = 0;
      body.render();
    });
  };

  const deform = () => {
    positions.set(mean);
    modes.forEach((mode, k) => {
      if (scores[k]) for (let i = 0; i < mode.length; i++) positions[i] += scores[k] * mode[i];
    });
    body.move(positions);
    const moved = scores.some(Boolean);
    byId("mean-caption").textContent = moved ? "Shape with the chosen scores" : "Mean shape";
    onChange(scores);
    draw();
  };

  const rows = modes.map((_, k) => {
    const row = document.createElement("div");
    row.className = "mode";
    const make = (tag, properties) => row.appendChild(Object.assign(document.createElement(tag), properties));
    make("b", { textContent: `Mode ${k + 1}` });
    make("span", { textContent: `${(100 * model.shares[k]).toFixed(model.shares[k] < 0.1 ? 1 : 0)} %` });
    const slider = make("input", { type: "range", min: -LIMIT, max: LIMIT, step: 0.05, value: 0, autocomplete: "off", ariaLabel: `Score of mode ${k + 1} in standard deviations` });
    const output = make("output", {});
    const play = make("button", { type: "button", textContent: "Play", ariaLabel: `Play mode ${k + 1}`, ariaPressed: "false" });
    slider.addEventListener("input", () => {
      stop();
      set(k, slider.valueAsNumber);
      deform();
    });
    play.addEventListener("click", () => (playing?.mode === k ? stop() : start(k)));
    return { row, slider, output, play };
  });
  byId("modes").append(...rows.map(({ row }) => row));

  function set(k, score) {
    scores[k] = Math.abs(score) < 0.025 ? 0 : score;
    rows[k].slider.value = score;
    rows[k].output.textContent = `${scores[k].toFixed(1).replace("-", "−").replace("−0.0", "0.0")} σ`;
    rows[k].slider.setAttribute("aria-valuetext", `${scores[k].toFixed(1)} standard deviations`);
  }

  let playing = null; // { mode, request }
  function stop() {
    if (!playing) return;
    cancelAnimationFrame(playing.request);
    const { play } = rows[playing.mode];
    Object.assign(play, { textContent: "Play", ariaPressed: "false" });
    playing = null;
  }
  function start(k) {
    stop();
    Object.assign(rows[k].play, { textContent: "Stop", ariaPressed: "true" });
    const phase = Math.asin(Math.max(-1, Math.min(1, scores[k] / LIMIT)));
    let first = null;
    const step = (time) => {
      first ??= time;
      set(k, LIMIT * Math.sin(phase + (2 * Math.PI * (time - first)) / PERIOD));
      deform();
      playing.request = requestAnimationFrame(step);
    };
    playing = { mode: k, request: requestAnimationFrame(step) };
  }

  const goTo = (values) => {
    stop();
    scores.forEach((_, k) => set(k, Math.max(-LIMIT, Math.min(LIMIT, values[k] ?? 0))));
    deform();
  };
  byId("reset-modes").addEventListener("click", () => {
    byId("scores-of").value = "";
    goTo([]);
  });
  byId("scores-of").append(...data.names.map((name, index) => new Option(name, index)));
  byId("scores-of").addEventListener("change", ({ target }) => target.value !== "" && goTo(model.scores[target.value]));

  let untouched = true;
  const resetView = () => {
    body.lookFrom(direction.clone().setLength(body.distanceToFit(direction)));
    untouched = true;
    draw();
  };
  body.controls.addEventListener("change", draw);
  body.controls.addEventListener("start", () => (untouched = false));
  body.canvas.addEventListener("keydown", (event) => {
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    if (moveByKey(body, event.key)) untouched = false;
    else if (event.key === "0" || event.key === "Home") resetView();
    else return;
    event.preventDefault();
  });
  new ResizeObserver(() => {
    if (!body.canvas.clientWidth) return;
    body.resize();
    if (untouched) resetView();
    body.render();
  }).observe(body.canvas);
  goTo([]);
  return { scores: () => scores.slice(), positions: () => Array.from(body.positions) };
}
