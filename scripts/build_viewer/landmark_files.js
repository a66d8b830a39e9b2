// Reads and writes landmark files: 3D Slicer Markups (.mrk.json), .fcsv, .csv, .txt and MeshLab's .pp.
// A page is a file without Python behind it, so it parses the files that a user drops on it. Landmarks that jaxsmw has
// read are in the data of the page. Every fault is an Error whose message is one sentence.

const LARGEST_FILE = 20e6; // bytes
const MOST_LANDMARKS = 1000;
const SYSTEMS = { LPS: "LPS", RAS: "RAS", 0: "RAS", 1: "LPS" }; // older files of Slicer have numbers
const SCHEMA = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#";

const readers = { ".json": readMarkups, ".fcsv": readFcsv, ".pp": readPickedPoints, ".csv": readTable, ".txt": readTable };

/** The landmarks of a file: `names`, `positions`, `system` ("LPS", "RAS" or null) and `omitted`, a number. */
export async function readLandmarkFile(file) {
  const read = readers[(file.name.match(/\.[^.]*$/)?.[0] ?? "").toLowerCase()];
  const fail = (fault) => {
    throw new Error(`${file.name}: ${fault}`);
  };
  if (!read) fail("this is not a landmark file; give .mrk.json, .fcsv, .csv, .txt or .pp.");
  if (file.size > LARGEST_FILE) fail("the file is larger than 20 MB; give a file that contains only landmarks.");
  let text;
  try {
    text = new TextDecoder("utf-8", { fatal: true }).decode(await file.arrayBuffer());
  } catch {
    fail("the file is not text in UTF-8; save it in UTF-8.");
  }
  if (text.includes("\0")) fail("the file is not text in UTF-8; save it in UTF-8.");
  let landmarks;
  try {
    landmarks = { system: null, omitted: 0, ...read(text) };
  } catch (error) {
    fail(error.message);
  }
  check(landmarks, fail);
  return landmarks;
}

function check({ names, positions }, fail) {
  if (!names.length) fail("the file contains no landmarks; give a file with at least one.");
  if (names.length > MOST_LANDMARKS) fail(`the file contains ${names.length} landmarks; give at most ${MOST_LANDMARKS}.`);
  const bad = positions.findIndex((position) => position.length !== 3 || !position.every(Number.isFinite));
  if (bad >= 0) fail(`landmark ${bad + 1} does not have three finite coordinates; correct it.`);
  const double = names.findIndex((name, i) => names.indexOf(name) < i);
  if (double >= 0) fail(`two landmarks are named ${names[double]}; give each landmark its own name.`);
}

// Numbers as text; Number() would also accept "" and "0x1".
const toNumber = (text) => (/^\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*$/.test(text) ? Number(text) : NaN);
const nameOr = (name, i) => String(name ?? "").trim() || String(i + 1);

function readMarkups(text) {
  let content;
  try {
    content = JSON.parse(text);
  } catch {
    throw new Error("the file is not valid JSON; save the landmarks again.");
  }
  const markups = (Array.isArray(content?.markups) ? content.markups : []).filter((markup) => markup?.controlPoints?.length);
  if (markups.length !== 1) {
    throw new Error(`the file has ${markups.length} lists of control points; give a file with one list.`);
  }
  const [{ controlPoints, coordinateSystem }] = markups;
  if (!Array.isArray(controlPoints)) throw new Error("the control points are not a list; save the landmarks again.");
  const defined = controlPoints.filter((point) => (point?.positionStatus ?? "defined") === "defined");
  return {
    names: defined.map((point) => nameOr(point?.label, controlPoints.indexOf(point))),
    positions: defined.map((point) => {
      const position = point?.position;
      return Array.isArray(position) ? position.map((entry) => (typeof entry === "number" ? entry : NaN)) : [];
    }),
    system: readSystem(coordinateSystem),
    omitted: controlPoints.length - defined.length,
  };
}

function readSystem(text) {
  if (text === undefined || text === null || text === "") return null;
  const name = String(text).trim().toUpperCase();
  if (!Object.hasOwn(SYSTEMS, name)) throw new Error(`the coordinate system is ${name}; use LPS or RAS.`);
  return SYSTEMS[name];
}

function readFcsv(text) {
  const lines = text.split(/\r\n|\r|\n/);
  const header = (name) => lines.map((line) => line.match(new RegExp(`^#\\s*${name}\\s*=(.*)$`, "i"))?.[1]).find((value) => value);
  const columns = (header("columns") ?? "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID")
    .split(",")
    .map((name) => name.trim());
  const rows = lines.filter((line) => line.trim() && !line.startsWith("#")).map((line) => cells(line, ","));
  const column = (row, name) => row[columns.indexOf(name)];
  return {
    names: rows.map((row, i) => nameOr(column(row, "label"), i)),
    positions: rows.map((row) => ["x", "y", "z"].map((axis) => toNumber(column(row, axis) ?? ""))),
    system: readSystem(header("CoordinateSystem")),
  };
}

function readTable(text) {
  const lines = text.split(/\r\n|\r|\n/).filter((line) => line.trim() && !line.startsWith("#"));
  const separator = [",", ";", "\t"].find((character) => lines[0]?.includes(character)) ?? " ";
  const rows = lines.map((line) => cells(line, separator));
  const isNumber = (cell) => !Number.isNaN(toNumber(cell));
  if (rows.length && !rows[0].slice(-3).some(isNumber)) rows.shift(); // the names of the columns
  rows.forEach((row, i) => {
    if (row.length === 3 || row.length === 4) return;
    throw new Error(`row ${i + 1} has ${row.length} columns; give the columns name, x, y, z, or x, y, z.`);
  });
  return {
    names: rows.map((row, i) => nameOr(row.length === 4 ? row[0] : "", i)),
    positions: rows.map((row) => row.slice(-3).map(toNumber)),
  };
}

/** The cells of a line. A cell in double quotes may contain the separator, and "" for a quote. */
function cells(line, separator) {
  if (separator === " ") return line.trim().split(/\s+/);
  const found = [];
  let cell = "", quoted = false;
  for (let i = 0; i < line.length; i++) {
    if (quoted && line[i] === '"' && line[i + 1] === '"') cell += line[++i];
    else if (line[i] === '"') quoted = !quoted;
    else if (line[i] === separator && !quoted) found.push(cell), (cell = "");
    else cell += line[i];
  }
  return [...found, cell].map((text) => text.trim());
}

function readPickedPoints(text) {
  // MeshLab writes <!DOCTYPE PickedPoints>. Declarations inside a document type could define entities.
  if (/<!DOCTYPE[^>]*\[|<!ENTITY/i.test(text)) throw new Error("the file declares entities; remove the declarations.");
  const content = new DOMParser().parseFromString(text, "application/xml");
  if (content.querySelector("parsererror")) throw new Error("the file is not valid XML; save the points again.");
  const points = [...content.querySelectorAll("point")];
  const picked = points.filter((point) => point.getAttribute("active") !== "0");
  return {
    names: picked.map((point) => nameOr(point.getAttribute("name"), points.indexOf(point))),
    positions: picked.map((point) => ["x", "y", "z"].map((axis) => toNumber(point.getAttribute(axis) ?? ""))),
    omitted: points.length - picked.length,
  };
}

/** A Markups file of 3D Slicer (schema 1.0.3). The numbers keep full precision. */
export function writeMarkups(names, positions, system) {
  const controlPoints = names.map((label, i) => ({
    id: String(i + 1),
    label,
    description: "",
    associatedNodeID: "",
    position: positions[i],
    orientation: system === "LPS" ? [-1, 0, 0, 0, -1, 0, 0, 0, 1] : [1, 0, 0, 0, 1, 0, 0, 0, 1],
    selected: true,
    locked: false,
    visibility: true,
    positionStatus: "defined",
  }));
  const markup = { type: "Fiducial", coordinateSystem: system, locked: false, labelFormat: "%N-%d", controlPoints };
  return `${JSON.stringify({ "@schema": SCHEMA, markups: [markup] }, null, 2)}\n`;
}

/** A table with the columns name, x, y and z. The numbers keep full precision. */
export function writeTable(names, positions) {
  const quote = (name) => (/[",;\t\n\r#]|^\s|\s$/.test(name) ? `"${name.replaceAll('"', '""')}"` : name);
  return ["name,x,y,z", ...names.map((name, i) => [quote(name), ...positions[i]].join(","))].join("\n") + "\n";
}
