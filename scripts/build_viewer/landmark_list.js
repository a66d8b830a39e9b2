// The landmarks and their history. An entry is { id, name, x, y, notes, loaded }; x and y are points on the source and
// on the target, or null; `loaded` is true for landmarks from files. Entries are never changed but replaced, so that the history keeps the earlier ones.

export const other = { x: "y", y: "x" };
export const isComplete = (entry) => Boolean(entry.x && entry.y);

export class LandmarkList {
  #history = [[]];
  #now = 0;
  #nextId = 0;
  selected = null; // the id of the selected landmark

  get entries() {
    return this.#history[this.#now];
  }
  get complete() {
    return this.entries.filter(isComplete);
  }
  get selection() {
    return this.entries.find((entry) => entry.id === this.selected) ?? null;
  }
  /** The selected landmark if it lacks one point. */
  get open() {
    return this.selection && !isComplete(this.selection) ? this.selection : null;
  }
  get canUndo() {
    return this.#now > 0;
  }
  get canRedo() {
    return this.#now < this.#history.length - 1;
  }

  #commit(entries) {
    this.#history.splice(++this.#now, Infinity, entries);
  }

  /** Undoes (-1) or redoes (1) one change, and selects the landmark that changed. */
  step(by) {
    if (by < 0 ? !this.canUndo : !this.canRedo) return;
    const before = this.entries;
    this.#now += by;
    const changed = this.entries.find((entry) => !before.includes(entry));
    this.selected = (changed ?? this.selection)?.id ?? null;
  }

  #replace(id, changes) {
    return this.entries.map((entry) => (entry.id === id ? { ...entry, ...changes } : entry));
  }

  #create(name) {
    return { id: this.#nextId++, name, x: null, y: null, notes: {} };
  }

  #unusedName() {
    const names = new Set(this.entries.map((entry) => entry.name));
    for (let i = 1; ; i++) if (!names.has(`L${i}`)) return `L${i}`;
  }

  /** Sets a point of the open landmark, or begins a new landmark. */
  place(side, point) {
    if (this.open) return this.move(this.selected, side, point);
    const entry = { ...this.#create(this.#unusedName()), [side]: point };
    this.#commit([...this.entries, entry]);
    this.selected = entry.id;
  }

  move(id, side, point) {
    const { notes } = this.entries.find((entry) => entry.id === id);
    this.#commit(this.#replace(id, { [side]: point, notes: { ...notes, [side]: undefined } }));
  }

  /** Shows a point of a drag that has not ended, without an entry in the history. */
  preview(id, side, point) {
    this.#history[this.#now] = this.#replace(id, { [side]: point });
  }

  /** Renames a landmark; returns a sentence if the name cannot be used. */
  rename(id, text) {
    const name = text.replace(/\p{Cc}/gu, " ").trim();
    const entry = this.entries.find((entry) => entry.id === id);
    if (!entry || name === entry.name) return "";
    if (!name) return "The name is empty; type a name.";
    if (this.entries.some((entry) => entry.name === name)) return `Another landmark is named ${name}; type another name.`;
    this.#commit(this.#replace(id, { name }));
    return "";
  }

  remove(id) {
    const at = this.entries.findIndex((entry) => entry.id === id);
    if (at < 0) return;
    this.#commit(this.entries.filter((entry) => entry.id !== id));
    this.selected = this.entries[Math.min(at, this.entries.length - 1)]?.id ?? null;
  }

  /** Selects the next (1) or the previous (-1) landmark, or the first or last one (-Infinity, Infinity). */
  select(by) {
    const at = this.entries.findIndex((entry) => entry.id === this.selected);
    const to = at < 0 && Number.isFinite(by) ? 0 : at + by;
    this.selected = this.entries[Math.max(0, Math.min(this.entries.length - 1, to))]?.id ?? null;
  }

  /** Gives the landmarks of these names their points on one side; new names become new landmarks. */
  merge(side, points) {
    const entries = [...this.entries];
    for (const { name, point, note } of points) {
      let at = entries.findIndex((entry) => entry.name === name);
      if (at < 0) at = entries.push({ ...this.#create(name), loaded: true }) - 1;
      entries[at] = { ...entries[at], [side]: point, notes: { ...entries[at].notes, [side]: note } };
    }
    this.#commit(entries);
    this.selected = null;
  }
}
