/** Plays tracks of films: which frame is now, and where its camera is. */

import * as THREE from "three";
import { discard } from "viewer/clouds.js";
import { SELECTED, STATE } from "viewer/colours.js";
import { byId, make } from "viewer/dom.js";
import { wayOf } from "viewer/figures.js";
import { Cameras } from "viewer/markers.js";

export class Player {
  /** @param {import("viewer/stage.js").Stage} stage */
  constructor(stage) {
    this.stage = stage;
    this.object = new THREE.Group();
    this.playing = false;
    byId("play").addEventListener("click", () => (this.playing ? this.pause() : this.play()));
    byId("time").addEventListener("input", () => {
      this.pause();
      this.goTo(Number(byId("time").value));
    });
    byId("track").addEventListener("change", () => this.choose(Number(byId("track").value)));
    new ResizeObserver(() => this.drawStates()).observe(byId("timeline"));
  }

  /** @param {any[]} tracks of a place */
  load(tracks) {
    this.pause();
    this.tracks = tracks;
    [...this.object.children].forEach(discard);
    byId("player").hidden = tracks.length === 0;
    byId("track").replaceChildren(...tracks.map((t, k) => make("option", { value: k }, t.name)));
    byId("track").hidden = tracks.length < 2;
    for (const track of tracks) this.object.add(wayOf(track.frames));
    this.camera = null;
    if (tracks.length) this.choose(0);
  }

  choose(row) {
    this.track = this.tracks[row];
    const { frames } = this.track;
    Object.assign(byId("time"), { min: frames[0].time_s, max: frames[frames.length - 1].time_s });
    this.drawStates();
    this.goTo(frames[0].time_s);
  }

  /** The last frame that is not later. @param {number} time_s */
  frameAt(time_s) {
    const { frames } = this.track;
    let [low, high] = [0, frames.length - 1];
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (frames[middle].time_s <= time_s + 1e-6) low = middle;
      else high = middle - 1;
    }
    return frames[low];
  }

  /** @param {number} time_s */
  goTo(time_s) {
    this.now = time_s;
    byId("time").value = time_s;
    const frame = this.frameAt(time_s);
    this.frame = frame;
    if (this.camera) discard(this.camera.object);
    this.camera = frame.pose === null ? null : new Cameras([frame.pose], SELECTED, 13);
    if (this.camera) this.object.add(this.camera.object);
    const state = make("b", {}, frame.state);
    state.style.background = STATE[frame.state];
    const place = frame.pose
      ? `${frame.inliers} inliers, ${frame.pose.utm.easting.toFixed(2)} E ${frame.pose.utm.northing.toFixed(2)} N`
      : frame.detail;
    byId("moment").replaceChildren(`${time_s.toFixed(2)} s, frame ${frame.index} `, state, ` ${place}`);
    this.stage.draw();
  }

  play() {
    const end = this.track.frames[this.track.frames.length - 1].time_s;
    if (this.now >= end) this.goTo(this.track.frames[0].time_s);
    this.playing = true;
    this.setButton();
    let before = performance.now();
    const step = (now) => {
      if (!this.playing) return;
      const time_s = this.now + ((now - before) / 1000) * Number(byId("speed").value);
      before = now;
      this.goTo(Math.min(time_s, end));
      if (time_s >= end) this.pause();
      else requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  pause() {
    this.playing = false;
    this.setButton();
  }

  setButton() {
    byId("play").textContent = this.playing ? "⏸" : "▶";
    byId("play").setAttribute("aria-label", this.playing ? "Pause" : "Play");
  }

  /** The strip above the slider: which state the track has when. */
  drawStates() {
    const canvas = byId("states");
    if (!this.track || !canvas.clientWidth) return;
    canvas.width = canvas.clientWidth;
    const { frames } = this.track;
    const start = frames[0].time_s;
    const perSecond = canvas.width / Math.max(frames[frames.length - 1].time_s - start, 1e-6);
    const context = canvas.getContext("2d");
    frames.forEach((frame, k) => {
      context.fillStyle = STATE[frame.state];
      const from = Math.floor((frame.time_s - start) * perSecond);
      const to = Math.ceil(((frames[k + 1]?.time_s ?? frame.time_s) - start) * perSecond);
      context.fillRect(from, 0, Math.max(to - from, 1), 6);
    });
  }
}
