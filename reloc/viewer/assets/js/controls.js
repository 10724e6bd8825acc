/** The controls on the left: view, colours, what is shown, the photo to be localised. */

import { colourOfMap, generationKeys, generationName, rampStyle, SCAN, STATE, STATUS } from "viewer/colours.js";
import { byId, check, colourDot, make, unitOf } from "viewer/dom.js";

const KINDS = { points: "points", photos: "photos", coverage: "coverage", tracks: "tracks" };
const LAST_GENERATION = generationKeys.length - 1;

export class Controls {
  /** @param {any} viewer of main.js */
  constructor(viewer) {
    this.viewer = viewer;
    this.kinds = Object.fromEntries(Object.keys(KINDS).map((kind) => [kind, true]));
    this.statuses = { active: true, quarantined: true, retired: false, unplaced: true };
    this.generations = generationKeys.map(() => true);
    byId("view-plan").addEventListener("click", () => viewer.view("plan"));
    byId("view-space").addEventListener("click", () => viewer.view("space"));
    byId("view-all").addEventListener("click", () => viewer.fit());
    byId("colour").addEventListener("change", () => viewer.refresh());
    byId("size").addEventListener("input", () => viewer.refresh());
    this.fillPlaces(viewer.document.places);
    if (viewer.document.queries) this.takePhotos();
  }

  get mode() {
    return byId("colour").value;
  }

  get size() {
    return Number(byId("size").value);
  }

  /** Whether a map's status and generation are among those shown. */
  takes(map) {
    return this.statuses[map.status] && this.generations[Math.min(map.generation, LAST_GENERATION)];
  }

  fillPlaces(places) {
    byId("place-row").hidden = places.length < 2;
    byId("place").replaceChildren(
      ...places.map((place, k) => make("option", { value: k }, place.own ? place.name : `${place.name}: ${place.maps.length} maps`)),
    );
    byId("place").addEventListener("change", () => this.viewer.open(Number(byId("place").value)));
  }

  async goToPlace(number) {
    byId("place").value = String(number);
    await this.viewer.open(number);
  }

  /** Boxes of what the place has. */
  fill(place) {
    const redraw = () => this.viewer.refresh();
    const boxes = (id, entries) => byId(id).replaceChildren(...entries);
    const counted = (wanted) => place.maps.filter(wanted).length;
    const kinds = Object.keys(KINDS).filter((kind) => kind !== "tracks" || place.trajectories.length);
    boxes("kinds", kinds.map((kind) => check(KINDS[kind], this.kinds[kind], (on) => {
      this.kinds[kind] = on;
      redraw();
    })));
    boxes("statuses", Object.keys(STATUS).filter((s) => counted((m) => m.status === s)).map((status) => {
      const text = `${status} (${counted((m) => m.status === status)})`;
      return check(text, this.statuses[status], (on) => {
        this.statuses[status] = on;
        redraw();
      }, STATUS[status]);
    }));
    const row = (map) => Math.min(map.generation, LAST_GENERATION);
    const generations = generationKeys.map((_, g) => g).filter((g) => counted((m) => row(m) === g));
    byId("generations").hidden = generations.length < 2;
    boxes("generations", generations.map((g) => {
      const text = `generation ${generationName(g)} (${counted((m) => row(m) === g)})`;
      return check(text, this.generations[g], (on) => {
        this.generations[g] = on;
        redraw();
      }, generationKeys[g]);
    }));
  }

  showMode(mode) {
    byId("view-plan").setAttribute("aria-pressed", String(mode === "plan"));
    byId("view-space").setAttribute("aria-pressed", String(mode === "space"));
    byId("north").hidden = mode !== "plan" || Boolean(this.viewer.place.own);
    byId("scale").hidden = mode !== "plan";
  }

  /** What the colours mean, as far as the boxes do not say it. */
  drawLegend() {
    const { place, ground } = this.viewer;
    const key = (colour, text) => make("span", { class: "key" }, colourDot(colour), text);
    const keys = [];
    if (this.mode === "height" && ground.heights[0] < ground.heights[1]) {
      const ramp = make("span", { class: "ramp" });
      ramp.style.background = rampStyle;
      const datum = place.height_datums.join(", ");
      const base = place.frame?.height_m ?? 0;
      const text = ground.heights.map((h) => `${(h + base).toFixed(1)} ${unitOf(place)}`);
      keys.push(ramp, make("span", { class: "ends" }, text[0], make("span", {}, datum), text[1]));
    }
    if (this.mode === "map") {
      place.maps.slice(0, 12).forEach((map, row) => keys.push(key(colourOfMap("map", map, row), map.name || map.id)));
    }
    if (!["own", "height"].includes(this.mode) && place.scans.length) keys.push(key(SCAN, "scan"));
    if (place.trajectories.length) for (const [state, colour] of Object.entries(STATE)) keys.push(key(colour, state));
    if (place.height_datums.length > 1) {
      keys.push(make("span", {}, `Heights of ${place.height_datums.join(" and ")} are drawn as they are.`));
    }
    byId("legend").replaceChildren(...keys);
  }

  /** A photo is chosen, or dropped anywhere. */
  takePhotos() {
    const input = byId("file");
    byId("choose").addEventListener("click", () => input.click());
    input.addEventListener("change", () => {
      if (input.files.length) this.viewer.ask(input.files[0]);
      input.value = "";
    });
    let inside = 0;
    const dropping = (on) => document.body.classList.toggle("dropping", on);
    addEventListener("dragenter", () => dropping(++inside > 0));
    addEventListener("dragleave", () => dropping(--inside > 0));
    addEventListener("dragover", (event) => event.preventDefault());
    addEventListener("drop", (event) => {
      event.preventDefault();
      inside = 0;
      dropping(false);
      if (event.dataTransfer.files.length) this.viewer.ask(event.dataTransfer.files[0]);
    });
  }
}
