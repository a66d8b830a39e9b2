// Landmark files of one pair: loading them with checks against the surface, saving them, and the command that uses them.

import { readLandmarkFile, writeMarkups, writeTable } from "./landmark_files.js";
import { download, quoted, titles } from "./landmark_panel.js";

const FAR = 0.02; // landmarks that are further from the surface, as a share of the diagonal, get a note
const OFF = 0.05; // files whose landmarks are further away on average are not loaded without a question

const byId = (id) => document.getElementById(id);
const sides = ["x", "y"];

export class LandmarkExchange {
  #waiting = null; // a file that lies off the surface: { side, file, landmarks }

  constructor(mode) {
    this.mode = mode;
  }

  get asks() {
    return this.#waiting !== null;
  }

  /** Loads the landmarks of one file for one body. */
  async load(side, files) {
    if (!files.length) return;
    this.mode.toggle(true);
    this.ask(null);
    if (files.length > 1) return this.mode.problem(`${files.length} files were dropped on the ${titles[side]}; drop one file on each body.`);
    try {
      this.#consider(side, files[0].name, await readLandmarkFile(files[0]));
    } catch (error) {
      this.mode.problem(error.message);
    }
  }

  /** Shows landmarks that belong to the page, as a mapping from sides to landmarks with the name of their file. */
  show(landmarks) {
    this.mode.toggle(true);
    for (const side of sides) {
      const { file, ...placed } = landmarks[side];
      this.#merge(side, file, placed, this.#snap(side, placed.positions));
    }
  }

  /** Merges the landmarks of a file, or asks first if they lie off the surface. */
  #consider(side, file, landmarks) {
    const snapped = this.#snap(side, landmarks.positions);
    const { diagonal } = this.mode.bodies[side].shape;
    if (mean(snapped) <= OFF * diagonal) return this.#merge(side, file, landmarks, snapped);
    const flipped = this.#snap(side, landmarks.positions.map(flip));
    const distance = (points) => this.#length(side, mean(points));
    const system = landmarks.system ? `, in ${landmarks.system}, ` : " ";
    const flipHelps = mean(flipped) <= OFF * diagonal;
    const cure =
      flipHelps
        ? `with the signs of x and y changed, as between LPS and RAS, they lie ${distance(flipped)} off`
        : "a change between LPS and RAS does not help, so check that file and mesh belong together and have the same unit";
    byId("landmark-flip").hidden = !flipHelps;
    this.ask({ side, file, landmarks }, `${file}: as written${system}the landmarks lie ${distance(snapped)} off the ${titles[side]} on average; ${cure}.`);
  }

  /** Asks whether to load a waiting file; null withdraws the question. */
  ask(waiting, question = "") {
    this.#waiting = waiting;
    this.mode.problem(question);
    byId("landmark-question").hidden = !waiting;
  }

  /** Loads the waiting file, with or without a change of signs. */
  answer(flips) {
    const { side, file, landmarks } = this.#waiting;
    this.ask(null);
    const positions = flips ? landmarks.positions.map(flip) : landmarks.positions;
    const system = flips && landmarks.system ? { LPS: "RAS", RAS: "LPS" }[landmarks.system] : landmarks.system;
    this.#merge(side, file, { ...landmarks, system }, this.#snap(side, positions));
  }

  #merge(side, file, { names, system, omitted }, snapped) {
    const { diagonal } = this.mode.bodies[side].shape;
    this.mode.list.merge(side, names.map((name, i) => {
      const { face, weights, distance } = snapped[i];
      const note = distance > FAR * diagonal ? `moved ${this.#length(side, distance)} to the ${titles[side]}` : undefined;
      return { name, point: { face, weights }, note };
    }));
    if (system) byId(`landmark-format-${side}`).value = system;
    const both = names.filter((name) => this.mode.list.complete.some((entry) => entry.name === name)).length;
    const far = snapped.filter(({ distance }) => distance > FAR * diagonal).length;
    const notes = [`${file}: ${names.length} landmarks on the ${titles[side]}, ${both} of them on both bodies`];
    if (system) notes.push(`coordinates ${system}, used as they are`);
    if (far) notes.push(`${far} lay off the surface and were moved to it`);
    if (omitted) notes.push(`${omitted} without a defined position left out`);
    this.mode.problem();
    this.mode.update(`${notes.join("; ")}.`);
  }

  #snap(side, positions) {
    const { shape } = this.mode.bodies[side];
    return positions.map((position) => shape.nearest(this.mode.placements[side].toPage(position)));
  }

  /** A length on the page, in the unit of the mesh file and as a share of the diagonal. */
  #length(side, length) {
    const share = (100 * length) / this.mode.bodies[side].shape.diagonal;
    return `${Number((length * this.mode.placements[side].scale).toPrecision(3))} (${Number(share.toPrecision(2))} % of the diagonal)`;
  }

  /** Saves the landmarks of one body. */
  save(side) {
    const { complete } = this.mode.list, name = this.#fileName(side);
    const names = complete.map((entry) => entry.name);
    const positions = complete.map((entry) => this.mode.position(side, entry));
    const system = byId(`landmark-format-${side}`).value;
    if (system) download(name, writeMarkups(names, positions, system), "application/json");
    else download(name, writeTable(names, positions), "text/csv");
    this.mode.update(`${name} is saved.`);
  }

  #fileName(side) {
    // A comma separates the two files in the command.
    const stem = (of) => this.mode.data[of].name.replace(/\.[^.]*$/, "").replace(/[^\p{L}\p{N}._-]+/gu, "_");
    const distinct = stem("x") === stem("y") ? `-${titles[side]}` : "";
    return `${stem(side)}${distinct}-landmarks${byId(`landmark-format-${side}`).value ? ".mrk.json" : ".csv"}`;
  }

  /** The command that uses the saved files. */
  get command() {
    const init = `landmarks:${this.#fileName("x")},${this.#fileName("y")}`;
    const meshes = sides.map((side) => quoted(this.mode.data[side].name.replace(/^-/, "./-")));
    return `jaxsmw match ${meshes.join(" ")} --init ${quoted(init)} --output map.txt`;
  }
}

const mean = (points) => points.reduce((sum, { distance }) => sum + distance, 0) / points.length;
const flip = ([x, y, z]) => [-x, -y, z];
