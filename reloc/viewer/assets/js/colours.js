/** What each colour means; docs/viewer.md says the same. */

export const STATUS = { active: "#2a7d3f", quarantined: "#d98a00", retired: "#8a8f98", unplaced: "#6b5b95" };
export const STATE = { tracking: "#1f5fa8", relocalised: "#8e44ad", lost: "#c0392b" };
export const SELECTED = "#d0006f";
export const ANSWER = "#0a8f3c";
export const SCAN = "#7b8794";
const GENERATION = ["#1f5fa8", "#2a9d8f", "#e0a030", "#c8553d"];
const MAP = ["#4e79a7", "#f28e2b", "#59a14f", "#b07aa1", "#e15759", "#76b7b2", "#9c755f", "#edc948", "#ff9da7", "#5b5b8b"];
/** From low to high; readable in grey and to people who see no red or no green. */
const RAMP = ["#30336b", "#2f6c9e", "#2aa198", "#8bc34a", "#f3d34a"];

/** @param {number} generation */
export const generationColour = (generation) => GENERATION[Math.min(generation, GENERATION.length - 1)];

/** @param {number} row of the map in its place */
export const mapColour = (row) => MAP[row % MAP.length];

/** The colour of a map's photos, and of its points unless they have colours of their own. */
export function colourOfMap(mode, map, row) {
  if (mode === "status") return STATUS[map.status];
  if (mode === "generation") return generationColour(map.generation);
  return mapColour(row);
}

export const generationName = (g) => (g >= GENERATION.length - 1 ? `${GENERATION.length - 1} and later` : `${g}`);
export const generationKeys = GENERATION;
export const rampStyle = `linear-gradient(to right, ${RAMP.join(", ")})`;

/**
 * Colours by height.
 * @param {Float32Array} xyz offsets, three for each point
 * @param {number} base height of the offsets' origin
 * @param {[number, number]} range lowest and highest colour's heights
 * @returns {Uint8Array} red, green, blue of each point
 */
export function heightColours(xyz, base, [low, high]) {
  const stops = RAMP.map((c) => [1, 3, 5].map((i) => parseInt(c.slice(i, i + 2), 16)));
  const rgb = new Uint8Array(xyz.length);
  const step = (stops.length - 1) / Math.max(high - low, 1e-6);
  for (let i = 0; i < xyz.length; i += 3) {
    const t = Math.min(Math.max((xyz[i + 2] + base - low) * step, 0), stops.length - 1);
    const k = Math.min(Math.floor(t), stops.length - 2);
    for (let c = 0; c < 3; c++) rgb[i + c] = stops[k][c] + (t - k) * (stops[k + 1][c] - stops[k][c]);
  }
  return rgb;
}
