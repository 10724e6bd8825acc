/** The maps of a place as the tree of which one placed which, with a box for each to show it. */

import { colourDot, make } from "viewer/dom.js";

export class Tree {
  /**
   * @param {HTMLElement} list
   * @param {any[]} maps of a place
   * @param {function(string): void} onSelect with a map's id
   * @param {function(): void} onToggle
   */
  constructor(list, maps, onSelect, onToggle) {
    this.maps = maps;
    this.boxes = new Map();
    this.names = new Map();
    this.dots = new Map();
    const entries = new Map(maps.map((map) => [map.id, this.entry(map, onSelect, onToggle)]));
    list.replaceChildren();
    for (const map of maps) {
      const parent = map.under === null ? undefined : entries.get(map.under);
      (parent?.querySelector(":scope > ul") ?? list).append(entries.get(map.id));
    }
    for (const empty of list.querySelectorAll("ul:empty")) empty.remove();
  }

  entry(map, onSelect, onToggle) {
    const box = make("input", { type: "checkbox", checked: true, "aria-label": `Show ${map.name || map.id}` });
    box.addEventListener("change", onToggle);
    const drift = map.drift_m === null ? "" : `, drift ${map.drift_m.toFixed(2)} m`;
    const about = map.no_place ? "no place on Earth" : `${map.status}, generation ${map.generation}${drift}`;
    const name = make("button", { title: map.id }, map.name || map.id, make("small", {}, about));
    name.addEventListener("click", () => onSelect(map.id));
    const dot = colourDot("#000");
    this.boxes.set(map.id, box);
    this.names.set(map.id, name);
    this.dots.set(map.id, dot);
    return make("li", {}, make("div", { class: "entry" }, box, dot, name), make("ul"));
  }

  /** @param {string} id */
  isShown(id) {
    return this.boxes.get(id).checked;
  }

  /** Maps that no box of status or generation lets through are pale. @param {function(any): boolean} taken */
  fade(taken) {
    for (const map of this.maps) this.boxes.get(map.id).parentElement.classList.toggle("off", !taken(map));
  }

  /** @param {?string} id of the map that is selected */
  mark(id) {
    for (const [other, name] of this.names) name.setAttribute("aria-current", String(other === id));
  }

  /** @param {function(any, number): string} colourOf a map and its row */
  paint(colourOf) {
    this.maps.forEach((map, row) => (this.dots.get(map.id).style.background = colourOf(map, row)));
  }
}
