/** The pointer over the view: which photo is under it, where it is on Earth, and the scale bar. */

import { where } from "viewer/data.js";
import { byId, unitOf } from "viewer/dom.js";

const REACH_PX = 12; // around a photo's dot
const STILL_MS = 150; // before the server is asked where the pointer is
const CLICK_PX = 4; // a pointer that moves farther while it is down has moved the view

export class Pointing {
  /** @param {any} viewer of main.js */
  constructor(viewer) {
    this.viewer = viewer;
    const canvas = viewer.stage.canvas;
    canvas.addEventListener("pointerdown", (event) => (this.down = [event.clientX, event.clientY]));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerleave", () => this.leave());
    canvas.addEventListener("click", (event) => {
      const moved = this.down ? Math.hypot(event.clientX - this.down[0], event.clientY - this.down[1]) : 0;
      const found = moved > CLICK_PX ? null : this.photoAt(event.offsetX, event.offsetY);
      if (found) viewer.openPhoto(found.map, found.photo);
    });
  }

  /** The photo whose dot is nearest, or null. */
  photoAt(px, py) {
    const { stage, place, cameras } = this.viewer;
    let best = null;
    let reach = REACH_PX;
    place.maps.forEach((map, row) => {
      if (!cameras[row].object.visible) return;
      for (const photo of map.photos) {
        const seen = stage.project(photo.center);
        const gap = seen === null ? Infinity : Math.hypot(seen[0] - px, seen[1] - py);
        if (gap < reach) [reach, best] = [gap, { map, photo }];
      }
    });
    return best;
  }

  move(event) {
    const { stage } = this.viewer;
    const [px, py] = [event.offsetX, event.offsetY];
    const found = this.photoAt(px, py);
    const hover = byId("hover");
    hover.hidden = found === null;
    if (found) {
      hover.textContent = found.photo.name;
      hover.style.left = `${px}px`;
      hover.style.top = `${py}px`;
    }
    stage.canvas.style.cursor = found ? "pointer" : "";
    clearTimeout(this.waiting);
    if (stage.mode !== "plan") {
      byId("readout").textContent = "";
      return;
    }
    const [east, north] = stage.unprojectPlan(px, py);
    const { own } = this.viewer.place;
    if (own) {
      byId("readout").textContent = `x ${east.toFixed(2)}, y ${north.toFixed(2)} ${unitOf(this.viewer.place)}, no place on Earth`;
      return;
    }
    const local = `E ${east.toFixed(2)} m, N ${north.toFixed(2)} m`;
    byId("readout").textContent = local;
    this.waiting = setTimeout(() => this.tell(local, east, north), STILL_MS);
  }

  /** Adds what the server knows of the spot. */
  async tell(local, east, north) {
    const { number, place } = this.viewer;
    const found = await where(number, [east, north, place.maps[0]?.coverage.ground_m ?? 0]).catch(() => null);
    if (found === null || byId("readout").textContent !== local) return;
    const { epsg, easting, northing } = found.utm;
    const degrees = `${found.latitude_deg.toFixed(7)}°, ${found.longitude_deg.toFixed(7)}°`;
    byId("readout").textContent = `${local}   EPSG:${epsg} ${easting.toFixed(2)} E ${northing.toFixed(2)} N   ${degrees}`;
  }

  leave() {
    clearTimeout(this.waiting);
    byId("hover").hidden = true;
    byId("readout").textContent = "";
  }

  /** A bar of 1, 2 or 5 times a power of ten metres. */
  drawScale() {
    const perPixel = this.viewer.stage.metresPerPixel;
    const power = 10 ** Math.floor(Math.log10(140 * perPixel));
    const length = [5, 2, 1].map((f) => f * power).find((l) => l <= 140 * perPixel);
    byId("scale-bar").style.width = `${length / perPixel}px`;
    const unit = this.viewer.ground ? unitOf(this.viewer.place) : "m";
    const far = length >= 1000 && unit === "m";
    byId("scale-text").textContent = far ? `${length / 1000} km` : `${+length.toPrecision(1)} ${unit}`;
  }
}
