/** Elements with text; texts of a database never become HTML. */

/**
 * @param {string} tag
 * @param {Object<string, any>} [properties] of the element; `class`, `aria-…` and `for` are attributes
 * @param {...(Node|string|null|undefined)} children
 * @returns {HTMLElement}
 */
export function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name === "class" || name.startsWith("aria-")) element.setAttribute(name, value);
    else element[name] = value;
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** @param {string} id @returns {any} the element of the page */
export const byId = (id) => document.getElementById(id);

/** A checkbox with its label; `dot` is a colour in front of the text. */
export function check(text, checked, onChange, dot = null) {
  const box = make("input", { type: "checkbox", checked });
  box.addEventListener("change", () => onChange(box.checked));
  return make("label", { class: "check" }, box, dot === null ? null : colourDot(dot), text);
}

/** @param {string} colour */
export function colourDot(colour) {
  const dot = make("span", { class: "dot" });
  dot.style.background = colour;
  return dot;
}

/** Rows of names and values; rows without a value are left out. @param {Array<[string, any]>} rows */
export function table(rows) {
  const list = make("dl");
  for (const [name, value] of rows) {
    if (value === null || value === undefined || value === "") continue;
    list.append(make("dt", {}, name), make("dd", {}, value instanceof Node ? value : String(value)));
  }
  return list;
}

/** @param {number} value metres */
export function metres(value) {
  const size = Math.abs(value);
  if (size < 0.01) return `${(value * 1000).toFixed(1)} mm`;
  if (size < 1) return `${(value * 100).toFixed(1)} cm`;
  if (size < 1000) return `${value.toFixed(size < 10 ? 2 : 1)} m`;
  return `${(value / 1000).toFixed(2)} km`;
}

/** What a length of a place is counted in: a map without a place may have no scale. */
export const unitOf = (place) => (!place.own || place.own.metric ? "m" : "units");
