// The panel of the landmark mode: messages, the list, files and the command. All texts are set as text, never as HTML.

import { isComplete } from "./landmark_list.js";

const byId = (id) => document.getElementById(id);
export const titles = { x: "source", y: "target" };

export const say = (id, text) => {
  if (byId(id).textContent !== text) byId(id).textContent = text;
};

/** Fills the list. `color` gives the colour of an entry. */
export function fillList(list, color) {
  const box = byId("landmark-list");
  box.replaceChildren(
    ...list.entries.map((entry, i) => {
      const option = document.createElement("li");
      option.id = `landmark-${entry.id}`;
      option.dataset.id = entry.id;
      option.role = "option";
      option.ariaSelected = String(entry.id === list.selected);
      const number = Object.assign(document.createElement("i"), { textContent: i + 1 });
      number.style.background = color(entry);
      const name = Object.assign(document.createElement("b"), { textContent: entry.name });
      const note = Object.assign(document.createElement("small"), { textContent: describe(entry) });
      option.append(number, name, note);
      return option;
    }),
  );
  const active = list.selection && byId(`landmark-${list.selected}`);
  if (active) {
    box.setAttribute("aria-activedescendant", active.id);
    // Only the list scrolls, not the page.
    const { offsetTop: top, offsetHeight: height } = active;
    if (top < box.scrollTop) box.scrollTop = top;
    else if (top + height > box.scrollTop + box.clientHeight) box.scrollTop = top + height - box.clientHeight;
  } else box.removeAttribute("aria-activedescendant");
  box.hidden = !list.entries.length;
}

function describe(entry) {
  const notes = Object.values(entry.notes).filter(Boolean);
  if (!isComplete(entry)) notes.unshift(`only on the ${titles[entry.x ? "x" : "y"]}`);
  return notes.join("; ");
}

/** Shows what can be done now. */
export function enableControls(list, { proposal, canSuggest }) {
  byId("landmark-accept").disabled = !proposal;
  byId("landmark-undo").disabled = !list.canUndo;
  byId("landmark-redo").disabled = !list.canRedo;
  byId("landmark-delete").disabled = !list.selection;
  byId("landmark-suggest").hidden = !canSuggest;
  const field = byId("landmark-name");
  field.disabled = !list.selection;
  // A name that is being typed belongs to the landmark that was selected when the typing began.
  if (document.activeElement !== field || !list.selection) fillName(list);
  for (const button of document.querySelectorAll("[data-save]")) button.disabled = !list.complete.length;
  byId("landmark-result").hidden = !list.complete.length;
  const left = list.entries.length - list.complete.length;
  const of = `${list.complete.length} ${list.complete.length === 1 ? "landmark" : "landmarks"}`;
  say("landmark-count", left ? `The files contain ${of} with points on both bodies, and leave out ${left}.` : `The files contain ${of}.`);
}

/** Shows the name of the selected landmark in the field of the name. */
export function fillName({ selection }) {
  byId("landmark-name").value = selection?.name ?? "";
  byId("landmark-name").dataset.id = selection?.id ?? "";
}

/** Saves a text as a file. */
export function download(name, text, type) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** Quotes a word of a command for POSIX shells if needed. */
export const quoted = (word) => (/^[\p{L}\p{N}_./:,+=@%-]+$/u.test(word) ? word : `'${word.replaceAll("'", "'\\''")}'`);

export async function copyCommand() {
  try {
    await navigator.clipboard.writeText(byId("landmark-command").textContent);
    say("landmark-status", "The command is copied.");
  } catch {
    getSelection().selectAllChildren(byId("landmark-command"));
    say("landmark-status", "The command is selected; press Ctrl+C to copy it.");
  }
}
